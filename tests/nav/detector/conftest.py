"""Networks in files: one of ours with random weights, and one that is written by hand and finds red squares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.network.network import DetectorNetwork, NetworkConfig

SQUARE_STRIDES = (8, 16, 32)
# A cell that is all red has this logit, one that is a quarter red or grey a score below one in ten thousand.
RED_LOGIT, GREY_LOGIT = 10.0, -30.0


def red_square_model(
    metadata: ModelMetadata | None = None,
    shape: Sequence[int | str] = ("b", 3, "h", "w"),
    channels: int = 5,
    strides: Sequence[int] = SQUARE_STRIDES,
    half_side_strides: float = 1.0,
) -> onnx.ModelProto:
    """Scores of cells by their mean red above the other colours, and a square box of fixed size around each centre."""
    weights = np.zeros((channels, 3, 1, 1), np.float32)
    weights[0, :, 0, 0] = (RED_LOGIT - GREY_LOGIT) * np.array([1, -0.5, -0.5])
    bias = np.full(channels, np.log(half_side_strides), np.float32)
    bias[0] = GREY_LOGIT
    nodes, outputs = [], []
    for stride in strides:
        mean, out = f"mean_{stride}", f"maps_{stride}"
        nodes.append(
            helper.make_node("AveragePool", ["images"], [mean], kernel_shape=[stride] * 2, strides=[stride] * 2)
        )
        nodes.append(helper.make_node("Conv", [mean, "weights", "bias"], [out]))
        outputs.append(helper.make_tensor_value_info(out, TensorProto.FLOAT, [None] * 4))
    graph = helper.make_graph(
        nodes,
        "red squares",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, shape)],
        outputs,
        [numpy_helper.from_array(weights, "weights"), numpy_helper.from_array(bias, "bias")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if metadata is not None:
        helper.set_model_props(model, {METADATA_KEY: metadata.to_json()})
    return model


@pytest.fixture
def red_squares(tmp_path: Path) -> Callable[..., Path]:
    """Writes such a model to a file."""

    def write(**kwargs: object) -> Path:
        path = tmp_path / "squares.onnx"
        onnx.save(red_square_model(**kwargs), path)  # type: ignore[arg-type]
        return path

    return write


def make_network(config: NetworkConfig, seed: int = 0) -> DetectorNetwork:
    """A network in use, with statistics and weights that let the images influence the outputs."""
    generator = torch.Generator().manual_seed(seed)
    state = torch.random.get_rng_state()
    try:
        torch.manual_seed(seed)
        network = DetectorNetwork(config)
    finally:
        torch.random.set_rng_state(state)
    with torch.no_grad():
        # Running statistics of real activations instead of 0 and 1, so that folding them is tested.
        network.train()(torch.rand(4, 3, 96, 128, generator=generator))
        for head in network.heads:
            for layer in (head.score, head.box):
                layer.weight.copy_(0.3 * torch.randn(layer.weight.shape, generator=generator))
    return network.eval()


@pytest.fixture(scope="session")
def network() -> Callable[..., DetectorNetwork]:
    return make_network
