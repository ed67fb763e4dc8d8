"""Parameters and operations of a network, counted in its ONNX file, so that any network is counted the same way."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple


class NetworkCost(NamedTuple):
    """Size and computation of a network.

    Attributes:
        parameters: number of weights and biases of its layers.
        gflops_per_image: multiplications and additions of convolutions and matrix products, in 10^9.
    """

    parameters: int
    gflops_per_image: float


def network_cost(file: Path, size_px: tuple[int, int]) -> NetworkCost:
    """Count the parameters and operations of a network.

    Args:
        file: an ONNX file with one input (B, 3, H, W).
        size_px: width and height of the input.

    Raises:
        ValueError: no such file, not a network, or an operation that is not counted or whose shape cannot be inferred.
    """
    import onnx

    try:
        model = onnx.load(str(file))
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror}") from error
    except Exception as error:  # protobuf's exceptions differ by its implementation
        raise ValueError(f"{file}: is not an ONNX network: {error}") from error
    for dimension, value in zip(model.graph.input[0].type.tensor_type.shape.dim, (2, 3, *size_px[::-1]), strict=True):
        dimension.ClearField("dim_param")
        dimension.dim_value = value
    # Stored shapes for another input size would contradict the inferred ones.
    del model.graph.value_info[:]
    for output in model.graph.output:
        output.type.tensor_type.ClearField("shape")
    try:
        graph = onnx.shape_inference.infer_shapes(model, data_prop=True).graph
    except onnx.shape_inference.InferenceError as error:
        raise ValueError(f"{file}: its shapes cannot be inferred: {str(error).strip().splitlines()[0]}") from error
    shapes = {
        each.name: [d.dim_value for d in each.type.tensor_type.shape.dim] for each in (*graph.value_info, *graph.output)
    }
    weights = {each.name: list(each.dims) for each in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            constant = [list(each.t.dims) for each in node.attribute if each.name == "value"]
            weights |= dict(zip(node.output, constant, strict=False))
        elif node.op_type in _SAME_NUMBERS and node.input[0] in weights:
            weights[node.output[0]] = weights[node.input[0]]
    products = sum(_products(node, shapes, weights) for node in graph.node)
    layers = {name for node in graph.node if node.op_type in _LAYERS for name in node.input if name in weights}
    return NetworkCost(sum(math.prod(weights[name]) for name in layers), 2e-9 * products / 2)


_COUNTED = ("Conv", "Gemm", "MatMul")
_LAYERS = (*_COUNTED, "BatchNormalization")
# Of a weight these change its type at most.
_SAME_NUMBERS = ("Identity", "QuantizeLinear", "DequantizeLinear")
_NOT_COUNTED = frozenset(
    {
        *("ConvTranspose", "ConvInteger", "QLinearConv", "DeformConv", "MatMulInteger", "QLinearMatMul", "Einsum"),
        *("Attention", "LSTM", "GRU", "RNN"),
    }
)


def _products(node: Any, shapes: dict[str, list[int]], weights: dict[str, list[int]]) -> int:
    """Number of multiplications of a node for a batch of two."""
    if node.op_type in _NOT_COUNTED:
        raise ValueError(f"{node.op_type} {node.name!r}: its multiplications are not counted")
    if node.op_type not in _COUNTED:
        return 0
    out = shapes.get(node.output[0], [])
    weight = weights.get(node.input[1], shapes.get(node.input[1], []))
    if not out or not weight or 0 in out or 0 in weight:
        raise ValueError(f"{node.op_type} {node.name!r}: its shape cannot be inferred, got {out} with weights {weight}")
    if node.op_type == "Conv":
        # Weights are (out, in / groups, kernel...): the sum runs over all axes but the first.
        return math.prod(out) * math.prod(weight[1:])
    if len(weight) == 1:
        return math.prod(out) * weight[0]
    transposed = any(attribute.name == "transB" and attribute.i for attribute in node.attribute)
    return math.prod(out) * (weight[-1] if transposed else weight[-2])
