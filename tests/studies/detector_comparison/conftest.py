"""Networks in files whose outputs a test chooses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.output_maps import MAP_CHANNELS, STRIDES


def _rows_network(path: Path, rows: np.ndarray, size_px: tuple[int, int] = (64, 64)) -> Path:
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


def _maps_network(path: Path, is_countable: bool = True) -> Path:
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


@pytest.fixture
def rows_network() -> Callable[..., Path]:
    """Writes a network with the output rows of other projects to a file."""
    return _rows_network


@pytest.fixture
def maps_network() -> Callable[..., Path]:
    """Writes a network of our kind to a file."""
    return _maps_network
