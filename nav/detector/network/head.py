"""The detection head, its anchor points, and the boxes that it predicts at them; see `nav.detector.output_maps`."""

from __future__ import annotations

from collections.abc import Sequence
from math import log
from typing import NamedTuple

import torch
from torch import Tensor, nn

from nav.detector.network.backbone import separable
from nav.detector.output_maps import LOG_DISTANCE_RANGE, MAP_CHANNELS, STRIDES

# Initial score of every cell, so that the many empty cells do not dominate the loss (RetinaNet, arXiv:1708.02002,
# section 4.1).
_PRIOR_SCORE = 0.01
# Initial distance of the sides in strides: boxes of 32, 64 and 128 px on the three levels; drogues have 17 to 340 px.
_PRIOR_DISTANCE = 2.0
_PREDICTION_SD = 0.01


class DetectionHead(nn.Module):
    """One-stage, anchor-free head of one level, decoupled: score and box have convolutions of their own.

    Source: YOLOX, arXiv:2107.08430.
    """

    def __init__(self, channels: int, depth: int) -> None:
        super().__init__()
        self.score_features = nn.Sequential(*(separable(channels) for _ in range(depth)))
        self.box_features = nn.Sequential(*(separable(channels) for _ in range(depth)))
        self.score = nn.Conv2d(channels, 1, 1)
        self.box = nn.Conv2d(channels, MAP_CHANNELS - 1, 1)

    def initialize_priors(self) -> None:
        """Set the last layers so that all cells predict nearly the prior score and distances."""
        for layer, bias in ((self.score, log(_PRIOR_SCORE / (1 - _PRIOR_SCORE))), (self.box, log(_PRIOR_DISTANCE))):
            assert layer.bias is not None
            nn.init.normal_(layer.weight, std=_PREDICTION_SD)
            nn.init.constant_(layer.bias, bias)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, 5, H, W), see `nav.detector.output_maps`; always float32, also in autocast."""
        score_features: Tensor = self.score_features(features)
        box_features: Tensor = self.box_features(features)
        device = features.device.type
        if not torch.is_autocast_enabled(device):
            return torch.cat((self.score(score_features), self.box(box_features)), dim=1)
        # bf16 has 8 significant bits: it would round distances to half a percent of the box.
        with torch.autocast(device, enabled=False):
            return torch.cat((self.score(score_features.float()), self.box(box_features.float())), dim=1)


class AnchorPoints(NamedTuple):
    """The anchor points of N cells, of all maps.

    Attributes:
        centers_px: (N, 2) x, y from the corner of the input. [px]
        strides_px: (N, 1) stride of each cell's map. [px]
    """

    centers_px: Tensor
    strides_px: Tensor


def anchor_points(maps: Sequence[Tensor]) -> AnchorPoints:
    """The anchor points of maps (B, 5, H, W), the finest map first, row by row."""
    centers, strides = [], []
    for stride, each in zip(STRIDES, maps, strict=True):
        rows, columns = (
            (torch.arange(count, device=each.device, dtype=torch.float32) + 0.5) * stride for count in each.shape[2:]
        )
        y, x = torch.meshgrid(rows, columns, indexing="ij")
        centers.append(torch.stack((x.flatten(), y.flatten()), dim=1))
        strides.append(torch.full((x.numel(), 1), float(stride), device=each.device))
    return AnchorPoints(torch.cat(centers), torch.cat(strides))


def flatten_maps(maps: Sequence[Tensor]) -> Tensor:
    """(B, N, 5) of float32 from maps (B, 5, H, W), in the order of `anchor_points`."""
    return torch.cat([each.float().flatten(2) for each in maps], dim=2).transpose(1, 2)


def decode_boxes(log_distances: Tensor, anchors: AnchorPoints) -> Tensor:
    """Decode the boxes of all cells.

    Args:
        log_distances: (B, N, 4) logarithms of the distances to left, top, right, bottom, in strides.
        anchors: the cells' anchor points.

    Returns:
        (B, N, 4) left, top, right, bottom. [px]
    """
    distances_px = log_distances.clamp(*LOG_DISTANCE_RANGE).exp() * anchors.strides_px
    low_px = anchors.centers_px - distances_px[..., :2]
    return torch.cat((low_px, anchors.centers_px + distances_px[..., 2:]), dim=-1)
