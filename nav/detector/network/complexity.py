"""How large a network is, and how much it computes."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn


class Complexity(NamedTuple):
    """Size and work of a network.

    Attributes:
        parameters: numbers that are trained.
        multiply_adds: of all convolutions and linear layers, for one image. Normalisation (folded into the convolutions
            when exported), activations, means and resizing are not counted, as usual.
    """

    parameters: int
    multiply_adds: int

    @property
    def gflops(self) -> float:
        """Operations in 10^9, a multiplication and an addition being two, as detectors' tables have it."""
        return 2 * self.multiply_adds / 1e9


def complexity(network: nn.Module, input_size_px: tuple[int, int]) -> Complexity:
    """Count what a network is and does.

    Args:
        network: takes (1, 3, H, W); runs once.
        input_size_px: width, height of the image.
    """
    counts: list[int] = []

    def count(layer: nn.Module, _inputs: tuple[Tensor, ...], output: Tensor) -> None:
        assert isinstance(layer.weight, Tensor)
        counts.append(output.numel() * layer.weight[0].numel())

    layers = [layer for layer in network.modules() if isinstance(layer, (nn.Conv1d, nn.Conv2d, nn.Linear))]
    hooks = [layer.register_forward_hook(count) for layer in layers]
    was_training = network.training
    first = next(network.parameters())
    try:
        with torch.no_grad():
            network.eval()(
                torch.zeros(1, 3, input_size_px[1], input_size_px[0], device=first.device, dtype=first.dtype)
            )
    finally:
        network.train(was_training)
        for hook in hooks:
            hook.remove()
    return Complexity(sum(each.numel() for each in network.parameters() if each.requires_grad), sum(counts))
