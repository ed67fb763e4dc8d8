"""Feature fusion of three levels: adaptively spatial (ASFF, Liu et al. 2019, arXiv:1911.09516), or concatenation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from nav.detector.network.backbone import pointwise, separable
from nav.detector.output_maps import STRIDES

Fusion = Literal["asff", "concat"]

# Number of channels from which the fusion weights of a level are computed (8 or 16 in the ASFF reference code).
_WEIGHT_CHANNELS = 8


class LevelResize(nn.Module):
    """Resizes features of one level to another: nearest neighbour upwards, convolutions of stride 2 downwards."""

    def __init__(self, channels: int, stride: int, target_stride: int) -> None:
        super().__init__()
        self.resize: nn.Module = nn.Identity()
        if target_stride < stride:
            self.resize = nn.Upsample(scale_factor=stride // target_stride, mode="nearest")
        elif target_stride == 2 * stride:
            self.resize = separable(channels, stride=2)
        elif target_stride == 4 * stride:
            self.resize = nn.Sequential(nn.MaxPool2d(3, 2, 1), separable(channels, stride=2))

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, C, H', W')."""
        resized: Tensor = self.resize(features)
        return resized


class AdaptiveFusion(nn.Module):
    """Takes a weighted mean of the three levels, with weights of its own at each location (ASFF)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.compress = nn.ModuleList(pointwise(channels, _WEIGHT_CHANNELS) for _ in STRIDES)
        self.weigh = nn.Conv2d(_WEIGHT_CHANNELS * len(STRIDES), len(STRIDES), 1)
        self.expand = separable(channels)

    def level_weights(self, levels: Sequence[Tensor]) -> Tensor:
        """(B, 3, H, W) weight of each level at each location; the weights sum to one."""
        compressed = [compress(level) for compress, level in zip(self.compress, levels, strict=True)]
        return torch.softmax(self.weigh(torch.cat(compressed, dim=1)), dim=1)

    def forward(self, levels: Sequence[Tensor]) -> Tensor:
        """Three times (B, C, H, W) -> (B, C, H, W)."""
        weights = self.level_weights(levels).to(levels[0].dtype)
        first, second, third = (weights[:, index : index + 1] * level for index, level in enumerate(levels))
        fused: Tensor = self.expand(first + second + third)
        return fused


class ConcatFusion(nn.Module):
    """Concatenates the three levels and reduces them to the channels of one."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reduce = pointwise(channels * len(STRIDES), channels)
        self.expand = separable(channels)

    def forward(self, levels: Sequence[Tensor]) -> Tensor:
        """Three times (B, C, H, W) -> (B, C, H, W)."""
        fused: Tensor = self.expand(self.reduce(torch.cat(tuple(levels), dim=1)))
        return fused


class Neck(nn.Module):
    """Brings the backbone's levels to the same number of channels, and fuses all of them into each."""

    def __init__(self, inputs: Sequence[int], channels: int, fusion: Fusion) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(pointwise(count, channels) for count in inputs)
        self.resize = nn.ModuleList(
            nn.ModuleList(LevelResize(channels, stride, target) for stride in STRIDES) for target in STRIDES
        )
        fuse = AdaptiveFusion if fusion == "asff" else ConcatFusion
        self.fuse = nn.ModuleList(fuse(channels) for _ in STRIDES)

    def resized(self, features: Sequence[Tensor], level: int) -> list[Tensor]:
        """All levels, resized to one of them: (B, C, H, W) each."""
        to_level = self.resize[level]
        assert isinstance(to_level, nn.ModuleList)
        return [resize(each) for resize, each in zip(to_level, features, strict=True)]

    def forward(self, features: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """The backbone's three levels -> three fused levels at the same strides, with equal numbers of channels."""
        levels = [lateral(each) for lateral, each in zip(self.lateral, features, strict=True)]
        return tuple(fuse(self.resized(levels, level)) for level, fuse in enumerate(self.fuse))
