"""Evaluation of a network on a corpus: batch statistics, predictions, average precision and score threshold.

In training each batch normalisation uses the statistics of its own small batch. The running means that it keeps lag
behind weights that still change, and averaged weights never had batches of their own. So both are measured over many
images before a network is evaluated or exported.
Source: Wu and Johnson 2021, arXiv:2105.07576, section 3 ("precise batch normalization").
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torch import Tensor, nn

from datasets_manifest.storage.manifest import SplitName
from geometry.boxes import intersection_over_union
from nav.detector.input_image import PADDING_DN
from nav.detector.multiscale_inference import detect_multiscale
from nav.training.corpus import Corpus
from nav.training.geometric_augmentation import Boxes, Image, paint_view, whole_view
from nav.training.prefetch_map import prefetch_map
from nav.training.training_settings import SizePx
from nav.training.training_state import ComputeDevice

MOST_BOXES = 10
"""Answers of an image that count, the best first."""


@dataclass(frozen=True)
class ValidationScores:
    """Fractions, 0 to 1.

    Attributes:
        ap: mean over overlaps from 0.5 to 0.95.
        ap50, ap75: at one overlap.
        recall50: of the drogues, with the lowest scores counted too.
    """

    ap: float
    ap50: float
    ap75: float
    recall50: float


def average_precision(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]]) -> ValidationScores | None:
    """Compare answers with the truth.

    Args:
        truth: of each image (n, 4) boxes x, y, width, height.
        found: of each image (m, 4) boxes and (m,) scores.

    Returns:
        None where there is no true box in any image.
    """
    boxes = [(image, box) for image, own in enumerate(truth, start=1) for box in own.tolist()]
    if not boxes:
        return None
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO()
        coco.dataset = {
            "images": [{"id": image + 1} for image in range(len(truth))],
            "categories": [{"id": 1, "name": "drogue"}],
            "annotations": [
                {"id": number, "image_id": image, "category_id": 1, "bbox": box, "area": box[2] * box[3], "iscrowd": 0}
                for number, (image, box) in enumerate(boxes, start=1)
            ],
        }
        coco.createIndex()
        answers = [
            (image, *box, score, 1)
            for image, (own, scores) in enumerate(found, start=1)
            for box, score in zip(own.tolist(), scores.tolist(), strict=True)
        ]
        if not answers:
            return ValidationScores(0.0, 0.0, 0.0, 0.0)
        evaluation = COCOeval(coco, coco.loadRes(np.array(answers, dtype=np.float64)), "bbox")
        evaluation.params.maxDets = [1, MOST_BOXES, MOST_BOXES]
        evaluation.params.areaRng = [[0, 1e10]]
        evaluation.params.areaRngLbl = ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    # (overlap, recall, class, area, most): overlaps are 0.5, 0.55 to 0.95.
    precision = evaluation.eval["precision"][:, :, 0, 0, -1]
    ap50, ap75 = (float(precision[index].mean()) for index in (0, 5))
    return ValidationScores(float(precision.mean()), ap50, ap75, float(evaluation.eval["recall"][0, 0, 0, -1]))


_LEAST_SCORE = 0.01  # average precision asks for all answers, down to where they no longer count


def to_tensor(images: NDArray[np.uint8], computing: ComputeDevice) -> Tensor:
    """(B, 3, H, W) from 0 to 1, on the device that computes, of (B, H, W, 3)."""
    # Red, green and blue stay beside each other in memory: channels last, as convolutions like it.
    return torch.from_numpy(images).to(computing.device, non_blocking=True).permute(0, 3, 1, 2).float().div_(255)


@dataclass(frozen=True, eq=False)
class Predictions:
    """Of N images, in corner coordinates of the network's input.

    Attributes:
        truth: N arrays (n, 4) of boxes.
        found: N arrays (m, 4) of boxes, the best first, with (m,) scores.
    """

    truth: list[Boxes]
    found: list[tuple[Boxes, Boxes]]


def predict(
    network: nn.Module,
    corpus: Corpus,
    split: SplitName,
    size_px: SizePx,
    batch_images: int,
    large_from_px: float,
    computing: ComputeDevice,
) -> Predictions:
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

    for group in prefetch_map(read, groups, threads=1, ahead=2):
        found += detect_multiscale([image for image, _ in group], run, large_from_px, _LEAST_SCORE, MOST_BOXES)
        truth += [boxes for _, boxes in group]
    return Predictions(truth, found)


def whole_image(corpus: Corpus, pair: int, eye: int, size_px: SizePx) -> tuple[Image, Boxes]:
    """An image as the detector sees it, not augmented, and its boxes."""
    canvas = np.full((*size_px, 3), PADDING_DN, dtype=np.uint8)
    view = whole_view(corpus.size_px[::-1], size_px[::-1])
    return canvas, paint_view(canvas, corpus.image(pair, eye), corpus.boxes(pair, eye), view)


_LEAST_OVERLAP = 0.5


def best_threshold(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]], otherwise: float) -> float:
    """A threshold for the best answers of all images, one to an image as the detector gives them.

    It is that with the fewest wrong answers and missed drogues, where an answer in an image without a drogue counts for
    more the fewer of these images there are: rates decide, not how many a dataset happens to have. As some hundred
    images do not tell which of many thresholds that is, it is the middle of all that have as few but for chance.

    Args:
        truth: of each image (n, 4) boxes, n 0 or 1.
        found: of each image (m, 4) boxes and (m,) scores, the best first.
        otherwise: where no answer is right.

    Returns:
        Midway between the highest and the lowest of those.
    """
    best = [
        (float(scores[0]), len(own) > 0, len(own) > 0 and intersection_over_union(own[0], boxes[0]) >= _LEAST_OVERLAP)
        for own, (boxes, scores) in zip(truth, found, strict=True)
        if len(scores)
    ]
    best.sort(key=lambda prediction: -prediction[0])
    right = np.cumsum([is_right for _, _, is_right in best])
    if not len(right) or right[-1] == 0:
        return otherwise
    shown = sum(len(own) > 0 for own in truth)
    # A missed drogue costs as much as a wrong box beside one.
    weight = shown / max(len(truth) - shown, 1)
    false = np.cumsum([(1.0 if shows else weight) * (not is_right) for _, shows, is_right in best])
    wrong = (shown - right) + false
    # The number of rare events scatters by its root.
    good = np.flatnonzero(wrong < max(wrong.min() + np.sqrt(wrong.min()), wrong.min() + 0.5))
    first, last = int(good[0]), int(good[-1])
    below = best[last + 1][0] if last + 1 < len(best) else 0.0
    return (best[first][0] + below) / 2


_MOST_IMAGES = 192  # a mean over as many is known to a twentieth of what images differ by
_BATCH_IMAGES = 16


def measure_batch_statistics(network: nn.Module, corpus: Corpus, size_px: SizePx, computing: ComputeDevice) -> None:
    """Replace a network's running means and variances by those over images of the split train.

    Args:
        network: in evaluation mode, and left so.
        corpus: whose images.
        size_px: (height, width) of the network's input.
        computing: where and how.
    """
    layers = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [layer.momentum for layer in layers]
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None  # the plain mean over all batches
        layer.train()
    try:
        for images in statistics_batches(corpus, size_px, computing):
            with torch.inference_mode(), computing.autocast():
                network(images)
    finally:
        for layer, momentum in zip(layers, momenta, strict=True):
            layer.momentum = momentum
            layer.eval()


def statistics_batches(corpus: Corpus, size_px: SizePx, computing: ComputeDevice) -> Iterator[Tensor]:
    """(B, 3, H, W) images of the split train, evenly over all datasets and scenes."""
    members = [(int(pair), eye) for pair in corpus.split("train") for eye in (0, 1)]
    chosen = np.linspace(0, len(members) - 1, min(_MOST_IMAGES, len(members))).astype(int)
    batches = -(-len(chosen) // _BATCH_IMAGES)
    # Each batch takes images from everywhere: the variance between scenes belongs to it.
    for first in range(batches):
        group = [members[i] for i in chosen[first::batches]]
        images = np.stack([whole_image(corpus, pair, eye, size_px)[0] for pair, eye in group])
        yield to_tensor(images, computing)
