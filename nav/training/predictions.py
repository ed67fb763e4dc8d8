"""What a network answers on images of a corpus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from datasets_manifest.storage.manifest import SplitName
from nav.detector.input_image import PADDING_DN
from nav.detector.multiscale_inference import find_at_scales
from nav.training.average_precision import MOST_BOXES
from nav.training.corpus import Corpus
from nav.training.image_views import Boxes, Image, show, whole_view
from nav.training.precision import Computing
from nav.training.prefetch_map import in_order
from nav.training.training_settings import SizePx

_LEAST_SCORE = 0.01  # average precision asks for all answers, down to where they no longer count


def to_tensor(images: NDArray[np.uint8], computing: Computing) -> Tensor:
    """(B, 3, H, W) from 0 to 1, on the device that computes, of (B, H, W, 3)."""
    # Red, green and blue stay beside each other in memory: channels last, as convolutions like it.
    return torch.from_numpy(images).to(computing.device, non_blocking=True).permute(0, 3, 1, 2).float().div_(255)


@dataclass(frozen=True, eq=False)
class Answers:
    """Of N images, in corner coordinates of the network's input.

    Attributes:
        truth: N arrays (n, 4) of boxes.
        found: N arrays (m, 4) of boxes, the best first, with (m,) scores.
    """

    truth: list[Boxes]
    found: list[tuple[Boxes, Boxes]]


def answer(
    network: nn.Module,
    corpus: Corpus,
    split: SplitName,
    size_px: SizePx,
    batch_images: int,
    large_from_px: float,
    computing: Computing,
) -> Answers:
    """What a network finds on both eyes' images of a split, which are shown as they are.

    Args:
        network: in evaluation mode.
        corpus: whose images.
        split: which of them.
        size_px: (height, width) of the network's input.
        batch_images: at a time.
        large_from_px: from which side on boxes come from a second pass at half the size, as the detector does it.
        computing: where and how.
    """
    members = [(int(pair), eye) for pair in corpus.split(split) for eye in (0, 1)]
    groups = [members[start : start + batch_images] for start in range(0, len(members), batch_images)]
    truth: list[Boxes] = []
    found: list[tuple[Boxes, Boxes]] = []

    def read(group: Sequence[tuple[int, int]]) -> list[tuple[Image, Boxes]]:
        return [whole_image(corpus, pair, eye, size_px) for pair, eye in group]

    def run(images: Sequence[Image]) -> list[NDArray[Any]]:
        with torch.inference_mode(), computing.autocast():
            maps = network(to_tensor(np.stack(images), computing))
        return [each.float().cpu().numpy() for each in maps]

    for group in in_order(read, groups, threads=1, ahead=2):
        found += find_at_scales([image for image, _ in group], run, large_from_px, _LEAST_SCORE, MOST_BOXES)
        truth += [boxes for _, boxes in group]
    return Answers(truth, found)


def whole_image(corpus: Corpus, pair: int, eye: int, size_px: SizePx) -> tuple[Image, Boxes]:
    """An image as the detector sees it, not augmented, and its boxes."""
    canvas = np.full((*size_px, 3), PADDING_DN, dtype=np.uint8)
    view = whole_view(corpus.size_px[::-1], size_px[::-1])
    return canvas, show(canvas, corpus.image(pair, eye), corpus.boxes(pair, eye), view)
