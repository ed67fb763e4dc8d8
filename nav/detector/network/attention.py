"""Attention to channels: ECA, which the paper puts in place of squeeze and excitation, and that one."""

from __future__ import annotations

from math import log2

from torch import Tensor, nn

from nav.detector.network.config import Attention

# MobileNetV3 (arXiv:1905.02244) squeezes to a quarter of the channels, as a multiple of 8 that is no tenth less.
_REDUCTION, _CHANNEL_STEP, _LEAST_SHARE = 4, 8, 0.9


def eca_kernel_size(channels: int) -> int:
    """How many neighbouring channels ECA looks at: |log2(C) / 2 + 1/2|, made odd (arXiv:1910.03151, eq. 12)."""
    size = int(abs(log2(channels) / 2 + 0.5))
    return size if size % 2 else size + 1


class EfficientChannelAttention(nn.Module):
    """Each channel's weight from the means of itself and its neighbours (ECA-Net, arXiv:1910.03151)."""

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
    return nearest if nearest >= _LEAST_SHARE * quarter else nearest + _CHANNEL_STEP


class SqueezeExcitation(nn.Module):
    """Each channel's weight from all means through a bottleneck (arXiv:1709.01507), as in MobileNetV3."""

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
    """The attention of that kind."""
    return EfficientChannelAttention(channels) if kind == "eca" else SqueezeExcitation(channels)
