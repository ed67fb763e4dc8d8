"""Counts of networks made by hand, by the closed form of a convolution."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from nav.detector.onnx_cost import network_cost

KERNEL = np.ones((4, 3, 3, 3), np.float32)
# Each of 64 x 96 outputs of four channels is a sum of 27 products, of which each counts as two operations.
GFLOPS = 2e-9 * 64 * 96 * 4 * 27


def network(folder: Path, nodes: list[Any], weights: dict[str, np.ndarray]) -> Path:
    """A network of these nodes, from `images` to `out`."""
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", channels, "h", "w"])
        for name, channels in (("images", 3), ("out", 4))
    ]
    given = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "network", ends[:1], ends[1:], given)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), folder / "network.onnx")
    return folder / "network.onnx"


def convolution(kernel: str) -> Any:
    return helper.make_node("Conv", ["images", kernel], ["out"], pads=[1, 1, 1, 1])


def test_weights_count_wherever_they_stand(tmp_path: Path) -> None:
    constant = helper.make_node("Constant", [], ["kernel"], value=numpy_helper.from_array(KERNEL))
    quantised = helper.make_node("DequantizeLinear", ["small", "scale"], ["kernel"])
    small = {"small": KERNEL.astype(np.int8), "scale": np.array(0.5, np.float32)}
    for nodes, weights in (([], {"kernel": KERNEL}), ([constant], {}), ([quantised], small)):
        cost = network_cost(network(tmp_path, [*nodes, convolution("kernel")], weights), (96, 64))
        assert cost.parameters == KERNEL.size
        assert cost.gflops_per_image == pytest.approx(GFLOPS, rel=1e-12)


def test_what_is_not_counted_is_no_zero(tmp_path: Path) -> None:
    turned = helper.make_node("ConvTranspose", ["images", "kernel"], ["out"], pads=[1, 1, 1, 1])
    file = network(tmp_path, [turned], {"kernel": KERNEL.transpose(1, 0, 2, 3).copy()})
    with pytest.raises(ValueError, match=r"ConvTranspose .*: its multiplications are not counted"):
        network_cost(file, (96, 64))
