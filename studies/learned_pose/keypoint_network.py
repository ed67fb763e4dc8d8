"""A small SimCC network: a residual backbone, features of stride 8, a layer from each keypoint's map to its bins."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nav.detector.network.backbone import batch_norm
from studies.learned_pose.keypoint_crops import CROP_PX
from studies.learned_pose.simcc import BINS

_CHANNELS = (16, 32, 64, 96, 128)
# The features that the keypoints' maps are made of.
_STRIDE = 8


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), batch_norm(outputs), nn.ReLU(inplace=True)
    )


class _Residual(nn.Module):
    """Two convolutions beside a shortcut (He et al. 2016, arXiv:1512.03385)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            _convolution(channels, channels), nn.Conv2d(channels, channels, 3, 1, 1, bias=False), batch_norm(channels)
        )
        self.activation = nn.ReLU(inplace=True)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> the same shape."""
        changed: Tensor = self.activation(features + self.layers(features))
        return changed


class KeypointNetwork(nn.Module):
    """Distributions of the coordinates of K keypoints."""

    def __init__(self, keypoints: int) -> None:
        super().__init__()
        first, second, third, fourth, fifth = _CHANNELS
        self.to_8 = nn.Sequential(
            _convolution(3, first, 2), _convolution(first, second, 2), _convolution(second, third, 2), _Residual(third)
        )
        self.to_16 = nn.Sequential(_convolution(third, fourth, 2), _Residual(fourth))
        self.to_32 = nn.Sequential(_convolution(fourth, fifth, 2), _Residual(fifth))
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        self.from_32, self.from_16 = nn.Conv2d(fifth, fourth, 1), nn.Conv2d(fourth, third, 1)
        self.maps = nn.Sequential(_convolution(third, third), nn.Conv2d(third, keypoints, 1))
        cells = (CROP_PX // _STRIDE) ** 2
        self.x, self.y = nn.Linear(cells, BINS), nn.Linear(cells, BINS)

    def forward(self, crops: Tensor) -> Tensor:
        """(B, 3, CROP_PX, CROP_PX) from 0 to 1 -> (B, 2, K, BINS) logits for x and y."""
        at_8: Tensor = self.to_8(crops - 0.5)
        at_16: Tensor = self.to_16(at_8)
        at_16 = at_16 + self.up(self.from_32(self.to_32(at_16)))
        maps = self.maps(at_8 + self.up(self.from_16(at_16))).flatten(2)
        return torch.stack([self.x(maps), self.y(maps)], dim=1)


def simcc_loss(logits: Tensor, targets: Tensor) -> Tensor:
    """Mean cross entropy of (B, 2, K, BINS) target distributions under the answers' distributions."""
    return -(targets * torch.log_softmax(logits, dim=-1)).sum(dim=-1).mean()
