"""One-stage head of one level: a score and a box in every cell, without anchors."""

from __future__ import annotations

from math import log

import torch
from torch import Tensor, nn

from nav.detector.maps import MAP_CHANNELS
from nav.detector.network.convolution import separable

# Before training a cell holds the drogue with this chance, so that the many empty cells don't drown the few others
# (RetinaNet, arXiv:1708.02002, section 4.1) ...
_PRIOR_SCORE = 0.01
# ... and sides are two strides away: 32, 64 and 128 px boxes on the three levels, where the drogue has 17 to 340 px.
_PRIOR_DISTANCE = 2.0
_PREDICTION_SD = 0.01


class DetectionHead(nn.Module):
    """Score and box have convolutions of their own, since they ask for different features (YOLOX, arXiv:2107.08430)."""

    def __init__(self, channels: int, depth: int) -> None:
        super().__init__()
        self.score_features = nn.Sequential(*(separable(channels) for _ in range(depth)))
        self.box_features = nn.Sequential(*(separable(channels) for _ in range(depth)))
        self.score = nn.Conv2d(channels, 1, 1)
        self.box = nn.Conv2d(channels, MAP_CHANNELS - 1, 1)

    def start_from_priors(self) -> None:
        """Set the last layers to answer nearly the same everywhere."""
        for layer, bias in ((self.score, log(_PRIOR_SCORE / (1 - _PRIOR_SCORE))), (self.box, log(_PRIOR_DISTANCE))):
            assert layer.bias is not None
            nn.init.normal_(layer.weight, std=_PREDICTION_SD)
            nn.init.constant_(layer.bias, bias)

    def forward(self, features: Tensor) -> Tensor:
        """(B, C, H, W) -> (B, 5, H, W), see `nav.detector.maps`; float32 in autocast too."""
        score_features: Tensor = self.score_features(features)
        box_features: Tensor = self.box_features(features)
        device = features.device.type
        if not torch.is_autocast_enabled(device):
            return torch.cat((self.score(score_features), self.box(box_features)), dim=1)
        # bf16 has 8 bits: logarithms of distances would be rounded to half a percent of the box.
        with torch.autocast(device, enabled=False):
            return torch.cat((self.score(score_features.float()), self.box(box_features.float())), dim=1)
