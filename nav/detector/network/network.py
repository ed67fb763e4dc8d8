"""The detector network: backbone, neck and heads, its configuration, and its complexity.

It follows section 3.1 of the seed paper: MobileNetV3, ECA in place of squeeze and excitation, ASFF, a one-stage head.
The paper gives neither the widths of neck and head nor the form of the boxes nor the losses; those are ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from math import log
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from nav.detector.network.backbone import Attention, MobileNetV3, Variant, pointwise, separable
from nav.detector.network.head import DetectionHead
from nav.detector.output_maps import STRIDES

Fusion = Literal["asff", "concat"]
FusionStart = Literal["random", "equal", "own"]

# Number of channels from which the fusion weights of a level are computed (8 or 16 in the ASFF reference code).
_WEIGHT_CHANNELS = 8
_OWN_WEIGHT = 0.8  # of a level in its own fusion, where fusion starts with it


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

    def initialize(self, start: FusionStart, level: int) -> None:
        """Set the weights of the three levels to the same at every location, `_OWN_WEIGHT` or a third for `level`."""
        if start == "random":
            return
        assert self.weigh.bias is not None
        nn.init.zeros_(self.weigh.weight)
        nn.init.zeros_(self.weigh.bias)
        if start == "own":
            with torch.no_grad():
                self.weigh.bias[level] = log(_OWN_WEIGHT / ((1 - _OWN_WEIGHT) / (len(STRIDES) - 1)))

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


# Channels of neck and head, and number of convolutions of the head before its prediction.
_WIDTH: dict[Variant, int] = {"l": 96, "s": 64}
_HEAD_DEPTH: dict[Variant, int] = {"l": 2, "s": 2}
# Images from 0 to 1 are centred and scaled: the first layer need not learn an offset, and its weights start at the
# usual scale.
_CENTRE = 0.5
_GAIN = 4.0


@dataclass(frozen=True)
class NetworkConfig:
    """The network's variant, and what its ablations change.

    Attributes:
        variant: `l` or `s`, a backbone of MobileNetV3-Large or -Small.
        attention: channel attention of the backbone: `eca`, or `se` as in the original MobileNetV3.
        fusion: of the three levels: `asff`, or `concat`.
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
        """Plain JSON that `from_dict` reads."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkConfig:
        """The configuration that `to_dict` wrote.

        Raises:
            ValueError: an unknown key, or a value that is not allowed.
        """
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise ValueError(f"network: has no {', '.join(unknown)}; it has variant, attention, fusion")
        return cls(**values)


class DetectorNetwork(nn.Module):
    """Predicts scores and boxes of drogues in images.

    Attributes:
        config: its variant, attention and fusion.
        gain: factor that scales centred images before the first layer.
    """

    def __init__(self, config: NetworkConfig) -> None:
        """Build a network with random weights, drawn from torch's generator."""
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
            head.initialize_priors()

    def initialize_filters(self, sd: float) -> None:
        """Draw all filters before batch normalisation with one standard deviation, from torch's generator.

        Their scale does not change what the network computes, but how fast it learns: Adam moves each weight by about
        the learning rate, whatever its size, so the share of a filter that a step changes is the rate over `sd`.
        """
        for module in self.modules():
            if isinstance(module, nn.Conv2d) and module.bias is None:
                nn.init.normal_(module.weight, std=sd)

    def initialize_scores(self, prior: float) -> None:
        """Let every cell predict nearly this score."""
        for head in self.heads:
            assert isinstance(head, DetectionHead)
            head.initialize_score(prior)

    def initialize_fusion(self, start: FusionStart) -> None:
        """Let ASFF begin with these weights; other fusions are left as they are."""
        for level, fusion in enumerate(self.neck.fuse):
            if isinstance(fusion, AdaptiveFusion):
                fusion.initialize(start, level)

    def fold_gain(self) -> None:
        """Fold the gain into the first layer's weights: the same outputs with one multiplication of the image less."""
        with torch.no_grad():
            self.backbone.stem_weights.mul_(self.gain)
        self.gain = 1.0

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute the output maps of scores and boxes.

        Args:
            images: (B, 3, H, W) red, green, blue, 0 to 1, display-encoded; H and W multiples of 32.

        Returns:
            (B, 5, H/s, W/s) for the strides s = 8, 16, 32; see `nav.detector.output_maps`.
        """
        centred = images - _CENTRE
        levels = self.neck(self.backbone(centred if self.gain == 1 else self.gain * centred))
        fine, middle, coarse = (head(level) for head, level in zip(self.heads, levels, strict=True))
        return fine, middle, coarse


class Complexity(NamedTuple):
    """Size and computation of a network.

    Attributes:
        parameters: number of trainable parameters.
        multiply_adds: of all convolutions and linear layers, for one image. As usual, normalisation (folded into the
            convolutions on export), activations, means and resizing are not counted.
    """

    parameters: int
    multiply_adds: int

    @property
    def gflops(self) -> float:
        """Operations in 10^9; a multiplication and an addition count as two, as is usual in tables of detectors."""
        return 2 * self.multiply_adds / 1e9


def complexity(network: nn.Module, input_size_px: tuple[int, int]) -> Complexity:
    """Count the parameters and operations of a network.

    Args:
        network: takes (1, 3, H, W); it runs once.
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
