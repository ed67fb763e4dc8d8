"""The MobileNetV3 backbone (Howard et al. 2019, arXiv:1905.02244), without its classifier, and its building blocks.

Channel attention is ECA (arXiv:1910.03151), which the seed paper puts in place of squeeze and excitation, or for the
ablation squeeze and excitation (arXiv:1709.01507) itself.
"""

from __future__ import annotations

from itertools import pairwise
from math import log2
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

Variant = Literal["l", "s"]
Attention = Literal["eca", "se"]

_STEM_CHANNELS = 16
# MobileNetV3 squeezes to a quarter of the channels, rounded to a multiple of 8 that is at most a tenth below it.
_REDUCTION, _CHANNEL_STEP, _MIN_FRACTION = 4, 8, 0.9
# A running mean over about 10 batches: in a short training weights change fast, and old means do not fit them.
_NORM_MOMENTUM, _NORM_EPSILON = 0.1, 1e-3


class DepthwiseConv(nn.Conv2d):
    """Depthwise convolution without bias, padded to keep the size.

    In bf16 autocast on a CPU, filters of 5x5 or of stride 2 are computed in float32: their bf16 kernels are several
    times slower than the float32 ones. The output has the dtype that autocast would have given it.
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
    """3x3 depthwise and 1x1 convolution, each with normalisation and ReLU (MobileNet, arXiv:1704.04861)."""
    depthwise = (DepthwiseConv(channels, 3, stride), batch_norm(channels), nn.ReLU())
    return nn.Sequential(*depthwise, *pointwise(channels, channels))


def eca_kernel_size(channels: int) -> int:
    """Kernel size of ECA in channels: |log2(C) / 2 + 1/2|, rounded to an odd number (arXiv:1910.03151, eq. 12)."""
    size = int(abs(log2(channels) / 2 + 0.5))
    return size if size % 2 else size + 1


class EfficientChannelAttention(nn.Module):
    """ECA: weights each channel by the means of itself and its neighbours (arXiv:1910.03151)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        size = eca_kernel_size(channels)
        self.across_channels = nn.Conv1d(1, 1, size, padding=size // 2, bias=False)
        self.gate = nn.Sigmoid()

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        means = features.mean(dim=(2, 3)).unsqueeze(1)
        weights: Tensor = self.gate(self.across_channels(means))
        return features * weights.squeeze(1)[:, :, None, None].to(features.dtype)


def squeezed_channels(channels: int) -> int:
    """Width of the bottleneck of squeeze and excitation."""
    quarter = channels // _REDUCTION
    nearest = max((quarter + _CHANNEL_STEP // 2) // _CHANNEL_STEP, 1) * _CHANNEL_STEP
    return nearest if nearest >= _MIN_FRACTION * quarter else nearest + _CHANNEL_STEP


class SqueezeExcitation(nn.Module):
    """Weights each channel by the means of all channels, through a bottleneck (arXiv:1709.01507), as in MobileNetV3."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        squeezed = squeezed_channels(channels)
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.excite = nn.Conv2d(squeezed, channels, 1)
        self.activation, self.gate = nn.ReLU(), nn.Hardsigmoid()

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H, W)."""
        means = features.mean(dim=(2, 3), keepdim=True)
        weights: Tensor = self.gate(self.excite(self.activation(self.squeeze(means))))
        return features * weights


def channel_attention(kind: Attention, channels: int) -> nn.Module:
    """A channel attention module of the given kind."""
    return EfficientChannelAttention(channels) if kind == "eca" else SqueezeExcitation(channels)


class Block(NamedTuple):
    """One row of tables 1 and 2 of the MobileNetV3 paper."""

    kernel: int
    expanded: int
    outputs: int
    has_attention: bool
    hard_swish: bool
    stride: int


_LARGE = (
    Block(3, 16, 16, False, False, 1),
    Block(3, 64, 24, False, False, 2),
    Block(3, 72, 24, False, False, 1),
    Block(5, 72, 40, True, False, 2),
    Block(5, 120, 40, True, False, 1),
    Block(5, 120, 40, True, False, 1),
    Block(3, 240, 80, False, True, 2),
    Block(3, 200, 80, False, True, 1),
    Block(3, 184, 80, False, True, 1),
    Block(3, 184, 80, False, True, 1),
    Block(3, 480, 112, True, True, 1),
    Block(3, 672, 112, True, True, 1),
    Block(5, 672, 160, True, True, 2),
    Block(5, 960, 160, True, True, 1),
    Block(5, 960, 160, True, True, 1),
)
_SMALL = (
    Block(3, 16, 16, True, False, 2),
    Block(3, 72, 24, False, False, 2),
    Block(3, 88, 24, False, False, 1),
    Block(5, 96, 40, True, True, 2),
    Block(5, 240, 40, True, True, 1),
    Block(5, 240, 40, True, True, 1),
    Block(5, 120, 48, True, True, 1),
    Block(5, 144, 48, True, True, 1),
    Block(5, 288, 96, True, True, 2),
    Block(5, 576, 96, True, True, 1),
    Block(5, 576, 96, True, True, 1),
)
BLOCKS: dict[Variant, tuple[Block, ...]] = {"l": _LARGE, "s": _SMALL}


class InvertedResidual(nn.Module):
    """Expansion, depthwise convolution, attention, projection, and a shortcut between equal sizes."""

    def __init__(self, inputs: int, block: Block, attention: Attention) -> None:
        super().__init__()
        activation = nn.Hardswish if block.hard_swish else nn.ReLU
        layers: list[nn.Module] = []
        if block.expanded != inputs:
            layers.append(pointwise(inputs, block.expanded, activation))
        layers += [DepthwiseConv(block.expanded, block.kernel, block.stride), batch_norm(block.expanded), activation()]
        if block.has_attention:
            layers.append(channel_attention(attention, block.expanded))
        layers.append(pointwise(block.expanded, block.outputs, nn.Identity))
        self.layers = nn.Sequential(*layers)
        self.has_shortcut = block.stride == 1 and inputs == block.outputs

    def forward(self, features: Tensor) -> Tensor:
        """(B, inputs, H, W) -> (B, outputs, H/stride, W/stride)."""
        changed: Tensor = self.layers(features)
        return features + changed if self.has_shortcut else changed


class MobileNetV3(nn.Module):
    """Features at strides 8, 16 and 32.

    Attributes:
        channels: number of channels of each of the three.
    """

    def __init__(self, variant: Variant, attention: Attention) -> None:
        super().__init__()
        blocks = BLOCKS[variant]
        self.stem = nn.Sequential(
            nn.Conv2d(3, _STEM_CHANNELS, 3, 2, 1, bias=False), batch_norm(_STEM_CHANNELS), nn.Hardswish()
        )
        inputs = (_STEM_CHANNELS, *(block.outputs for block in blocks[:-1]))
        built = [InvertedResidual(count, block, attention) for count, block in zip(inputs, blocks, strict=True)]
        # A stage ends before the next block that halves the size; the outputs of the last three stages are used.
        starts = [index for index, block in enumerate(blocks) if block.stride == 2]
        *_, to_16, to_32 = starts
        bounds = (0, to_16, to_32, len(blocks))
        self.stages = nn.ModuleList(nn.Sequential(*built[low:high]) for low, high in pairwise(bounds))
        self.channels = tuple(blocks[high - 1].outputs for high in bounds[1:])

    @property
    def stem_weights(self) -> Tensor:
        """(16, 3, 3, 3) of the first convolution, which has no bias."""
        convolution = self.stem[0]
        assert isinstance(convolution, nn.Conv2d)
        return convolution.weight

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        """(B, 3, H, W) -> three maps of `channels` at strides 8, 16, 32."""
        features: Tensor = self.stem(images)
        levels = []
        for stage in self.stages:
            features = stage(features)
            levels.append(features)
        return tuple(levels)
