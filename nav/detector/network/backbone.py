"""The trunk of MobileNetV3 (Howard et al. 2019, arXiv:1905.02244), up to where its classifier begins."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

from torch import Tensor, nn

from nav.detector.network.attention import channel_attention
from nav.detector.network.config import Attention, Variant
from nav.detector.network.convolution import DepthwiseConv, batch_norm, pointwise

_STEM_CHANNELS = 16


class Block(NamedTuple):
    """One row of the paper's tables 1 and 2: kernel, expanded and output channels, attention, hard swish, stride."""

    kernel: int
    expanded: int
    outputs: int
    attends: bool
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
    """Expansion, depthwise convolution, attention, projection, and a shortcut where sizes allow it."""

    def __init__(self, inputs: int, block: Block, attention: Attention) -> None:
        super().__init__()
        activation = nn.Hardswish if block.hard_swish else nn.ReLU
        layers: list[nn.Module] = []
        if block.expanded != inputs:
            layers.append(pointwise(inputs, block.expanded, activation))
        layers += [DepthwiseConv(block.expanded, block.kernel, block.stride), batch_norm(block.expanded), activation()]
        if block.attends:
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
        channels: of the three.
    """

    def __init__(self, variant: Variant, attention: Attention) -> None:
        super().__init__()
        blocks = BLOCKS[variant]
        self.stem = nn.Sequential(
            nn.Conv2d(3, _STEM_CHANNELS, 3, 2, 1, bias=False), batch_norm(_STEM_CHANNELS), nn.Hardswish()
        )
        inputs = (_STEM_CHANNELS, *(block.outputs for block in blocks[:-1]))
        built = [InvertedResidual(count, block, attention) for count, block in zip(inputs, blocks, strict=True)]
        # A stage ends before the next block that halves the size; the last three stages are the ones that are used.
        starts = [index for index, block in enumerate(blocks) if block.stride == 2]
        *_, to_16, to_32 = starts
        bounds = (0, to_16, to_32, len(blocks))
        self.stages = nn.ModuleList(nn.Sequential(*built[low:high]) for low, high in pairwise(bounds))
        self.channels = tuple(blocks[high - 1].outputs for high in bounds[1:])

    @property
    def first_weights(self) -> Tensor:
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
