"""Convolutions with batch normalisation, and depthwise ones that stay quick in bf16 autocast."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

# A running mean over about 10 batches: weights move fast in a short training, and old means do not fit them.
_NORM_MOMENTUM, _NORM_EPSILON = 0.1, 1e-3


class DepthwiseConv(nn.Conv2d):
    """One filter a channel, without bias, padded to keep its place.

    In bf16 autocast on a CPU the slow kinds leave autocast and compute in float32: the bf16 kernels of depthwise
    filters of 5x5 or of stride 2 are several times slower than the float32 ones, so that autocast would win nothing.
    The answer has the type that autocast would have given it.
    """

    def __init__(self, channels: int, kernel: int, stride: int = 1) -> None:
        super().__init__(channels, channels, kernel, stride, kernel // 2, groups=channels, bias=False)
        self._slow_in_bf16 = kernel > 3 or stride > 1

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H/stride, W/stride)."""
        device = features.device.type
        if device != "cpu" or not self._slow_in_bf16 or not torch.is_autocast_enabled(device):
            return super().forward(features)
        with torch.autocast(device, enabled=False):
            filtered = functional.conv2d(
                features.float(), self.weight, None, self.stride, self.padding, self.dilation, self.groups
            )
        return filtered.to(torch.get_autocast_dtype(device))


def batch_norm(channels: int) -> nn.BatchNorm2d:
    """Batch normalisation for small batches and short trainings."""
    return nn.BatchNorm2d(channels, eps=_NORM_EPSILON, momentum=_NORM_MOMENTUM)


def pointwise(inputs: int, outputs: int, activation: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    """1x1 convolution, normalisation, activation."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), batch_norm(outputs), activation())


def separable(channels: int, stride: int = 1) -> nn.Sequential:
    """3x3 depthwise convolution, then 1x1, each with normalisation and ReLU (MobileNet, arXiv:1704.04861)."""
    depthwise = (DepthwiseConv(channels, 3, stride), batch_norm(channels), nn.ReLU())
    return nn.Sequential(*depthwise, *pointwise(channels, channels))
