"""The detector network: backbone, neck and heads, its configuration, and its complexity.

It follows section 3.1 of the seed paper: MobileNetV3, ECA in place of squeeze and excitation, ASFF, a one-stage head.
The paper gives neither the widths of neck and head nor the form of the boxes nor the losses; those are ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor, nn

from nav.detector.network.backbone import Attention, MobileNetV3, Variant
from nav.detector.network.head import DetectionHead
from nav.detector.network.neck import Fusion, Neck
from nav.detector.output_maps import STRIDES

# Channels of neck and head, and how many convolutions the head has before its answer.
_WIDTH: dict[Variant, int] = {"l": 96, "s": 64}
_HEAD_DEPTH: dict[Variant, int] = {"l": 2, "s": 2}
# Of images from 0 to 1, so that the first layer needs no offset to learn and its weights start at a common size.
_CENTRE = 0.5
_GAIN = 4.0


@dataclass(frozen=True)
class NetworkConfig:
    """The network's variant and the switches of its ablations.

    Attributes:
        variant: trunk of MobileNetV3-Large or -Small.
        attention: of channels in the trunk: ECA, or the squeeze and excitation of the original MobileNetV3.
        fusion: of the three scales: ASFF, or concatenation.
    """

    variant: Variant = "l"
    attention: Attention = "eca"
    fusion: Fusion = "asff"

    def __post_init__(self) -> None:
        for name, choices in (("variant", Variant), ("attention", Attention), ("fusion", Fusion)):
            if getattr(self, name) not in get_args(choices):
                allowed = ", ".join(get_args(choices))
                raise ValueError(f"{name}: must be one of {allowed}, got {getattr(self, name)!r}")

    def to_dict(self) -> dict[str, str]:
        """What `from_dict` reads; plain JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkConfig:
        """The configuration that `to_dict` wrote.

        Raises:
            ValueError: a key that does not exist, or a value that is not allowed.
        """
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise ValueError(f"network: has no {', '.join(unknown)}; it has variant, attention, fusion")
        return cls(**values)


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
            (B, 5, H/s, W/s) for the strides s = 8, 16, 32, see `nav.detector.output_maps`.
        """
        centred = images - _CENTRE
        levels = self.neck(self.backbone(centred if self.gain == 1 else self.gain * centred))
        fine, middle, coarse = (head(level) for head, level in zip(self.heads, levels, strict=True))
        return fine, middle, coarse


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
