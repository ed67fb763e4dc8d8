"""The moving average of a network's weights, which is better than any of them and is what gets used."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from nav.detector.network.network import DetectorNetwork

_RAMP_STEPS = 10  # the average of the first n steps forgets about n/10 of them at a time


class MovingAverage:
    """Of weights; running means of batch normalization are measured for them, see `nav.training.evaluation`.

    Attributes:
        network: that has the averages; never trained.
    """

    def __init__(self, network: DetectorNetwork, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, network: DetectorNetwork, step: int) -> None:
        """Take in the weights after a step, counted from 0."""
        decay = min(self._decay, (1 + step) / (_RAMP_STEPS + step))
        averages: list[Tensor] = []
        currents: list[Tensor] = []
        for average, current in zip(self.network.state_dict().values(), network.state_dict().values(), strict=True):
            if average.is_floating_point():
                averages.append(average)
                currents.append(current)
            else:
                average.copy_(current)
        torch._foreach_lerp_(averages, currents, 1 - decay)
