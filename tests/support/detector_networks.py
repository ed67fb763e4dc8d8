"""Networks for tests: random weights of our kind, one by hand that finds red squares, and chosen outputs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from nav.detector.output_maps import MAP_CHANNELS, STRIDES

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


def write_red_squares(
    folder: Path,
    metadata: ModelMetadata | None = None,
    shape: Sequence[int | str] = ("b", 3, "h", "w"),
    channels: int = 5,
    strides: Sequence[int] = SQUARE_STRIDES,
    half_side_strides: float = 1.0,
) -> Path:
    """The file of such a model, in a folder."""
    path = folder / "squares.onnx"
    onnx.save(red_square_model(metadata, shape, channels, strides, half_side_strides), path)
    return path


def set_metadata(file: Path, metadata: ModelMetadata) -> None:
    """Write metadata into a network's file."""
    model = onnx.load(file)
    helper.set_model_props(model, {METADATA_KEY: metadata.to_json()})
    onnx.save(model, file)


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


def write_rows_network(path: Path, rows: np.ndarray, size_px: tuple[int, int] = (64, 64)) -> Path:
    """A network with constant output rows, to which it adds zero times the mean of its input."""
    path.parent.mkdir(parents=True, exist_ok=True)
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["rows", "nothing"], ["answer"]),
    ]
    constants = [
        numpy_helper.from_array(rows.astype(np.float32), "rows"),
        numpy_helper.from_array(np.array(0.0, np.float32), "zero"),
    ]
    width, height = size_px
    graph = helper.make_graph(
        nodes,
        "rows",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [2, 3, height, width])],
        [helper.make_tensor_value_info("answer", TensorProto.FLOAT, list(rows.shape))],
        constants,
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


def write_maps_network(path: Path, is_countable: bool = True) -> Path:
    """One of our kind, for 64 x 64 px: a convolution for each scale, whose boxes and scores depend on the picture.

    Where it is not countable, an operation that only onnxruntime knows hides the shapes of what follows it.
    """
    rng = np.random.default_rng(1)
    weights, outputs = [], []
    nodes = [
        helper.make_node("Relu", ["images"], ["seen"])
        if is_countable
        else helper.make_node("Gelu", ["images"], ["seen"], domain="com.microsoft")
    ]
    for stride in STRIDES:
        kernel = rng.normal(0, 1 / stride, (MAP_CHANNELS, 3, stride, stride)).astype(np.float32)
        weights.append(numpy_helper.from_array(kernel, f"weights_{stride}"))
        nodes.append(
            helper.make_node("Conv", ["seen", f"weights_{stride}"], [f"maps_{stride}"], strides=[stride, stride])
        )
        outputs.append(helper.make_tensor_value_info(f"maps_{stride}", TensorProto.FLOAT, [None] * 4))
    inputs = [helper.make_tensor_value_info("images", TensorProto.FLOAT, ["b", 3, "h", "w"])]
    graph = helper.make_graph(nodes, "maps", inputs, outputs, weights)
    domains = [helper.make_opsetid("", 17), helper.make_opsetid("com.microsoft", 1)]
    model = helper.make_model(graph, opset_imports=domains, ir_version=8)
    helper.set_model_props(model, {METADATA_KEY: ModelMetadata(input_size_px=(64, 64)).to_json()})
    onnx.save(model, str(path))
    return path
