"""The detector network: trunk, fusion of scales, head.

After the seed paper's section 3.1: MobileNetV3, ECA in place of squeeze and excitation, ASFF, a one-stage head. The
paper gives neither the widths of neck and head nor the form of the boxes nor the losses; those are ours.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nav.detector.maps import STRIDES
from nav.detector.network.backbone import MobileNetV3
from nav.detector.network.config import NetworkConfig, Variant
from nav.detector.network.head import DetectionHead
from nav.detector.network.neck import Neck

# Channels of neck and head, and how many convolutions the head has before its answer.
_WIDTH: dict[Variant, int] = {"l": 96, "s": 64}
_HEAD_DEPTH: dict[Variant, int] = {"l": 2, "s": 2}
# Of images from 0 to 1, so that the first layer needs no offset to learn and its weights start at a common size.
_CENTRE = 0.5
_GAIN = 4.0


class DetectorNetwork(nn.Module):
    """Finds drogues in images.

    Attributes:
        config: which variant it is.
        gain: of centred images, before the first layer.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """A network with random weights, from torch's generator."""
        super().__init__()
        self.config = config
        self.gain = _GAIN
        width = _WIDTH[config.variant]
        self.backbone = MobileNetV3(config.variant, config.attention)
        self.neck = Neck(self.backbone.channels, width, config.fusion)
        self.heads = nn.ModuleList(DetectionHead(width, _HEAD_DEPTH[config.variant]) for _ in STRIDES)
        self._initialise()

    def _initialise(self) -> None:
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_in")
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        for head in self.heads:
            assert isinstance(head, DetectionHead)
            head.start_from_priors()

    def fold_gain(self) -> None:
        """Put the images' gain into the first layer's weights: the same answers for a product of images less."""
        with torch.no_grad():
            self.backbone.first_weights.mul_(self.gain)
        self.gain = 1.0

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Maps of scores and boxes.

        Args:
            images: (B, 3, H, W) red, green, blue, 0 to 1, display-encoded; H and W multiples of 32.

        Returns:
            (B, 5, H/s, W/s) for the strides s = 8, 16, 32, see `nav.detector.maps`.
        """
        centred = images - _CENTRE
        levels = self.neck(self.backbone(centred if self.gain == 1 else self.gain * centred))
        fine, middle, coarse = (head(level) for head, level in zip(self.heads, levels, strict=True))
        return fine, middle, coarse
