"""Evaluation of a network on a corpus: batch statistics, predictions, average precision and score threshold.

While it learns, a network searches pictures as they are cached, at the size of its input. At the end the detector of
the exported file searches the pictures as they were taken, as users let it.

In training each batch normalisation uses the statistics of its own small batch. The running means that it keeps lag
behind weights that still change, and averaged weights never had batches of their own. So both are measured over many
images before a network is evaluated or exported.
Source: Wu and Johnson 2021, arXiv:2105.07576, section 3 ("precise batch normalization").
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator, Sequence
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
from geometry.stereo import EYES
from nav.detector.detector import Detection
from nav.detector.input_image import PADDING_DN, letterbox
from nav.detector.multiscale_inference import detect_multiscale
from nav.detector.onnx_detector import OnnxDetector
from nav.training.augmentation import Boxes, CanvasWindow, Image, clip_boxes, paint_view, whole_view
from nav.training.corpus import Corpus
from nav.training.prefetch_map import prefetch_map
from nav.training.training_settings import SizePx
from nav.training.training_state import ComputeDevice

DEFAULT_THRESHOLD = 0.5
"""Score threshold where nothing was measured."""

MAX_BOXES = 10
"""Number of predictions of an image that are scored, the best first."""
_MIN_SCORE = 0.01  # average precision needs all predictions, down to scores that hardly change it
_STATISTICS_IMAGES = 192  # their mean is uncertain by about a fourteenth of the standard deviation between images
_STATISTICS_BATCH = 16
_MIN_IOU = 0.5
# Missed drogues that a box in an image without any counts for: what is mistaken for a drogue is followed, while a
# tracker finds a missed one again in the next pair.
_FALSE_ALARM_WEIGHT = 3.0


def to_tensor(images: NDArray[np.uint8], compute: ComputeDevice) -> Tensor:
    """(B, 3, H, W) from 0 to 1 on the compute device, from images (B, H, W, 3)."""
    # The memory stays channels last, the layout in which convolutions are fastest.
    return torch.from_numpy(images).to(compute.device, non_blocking=True).permute(0, 3, 1, 2).float().div_(255)


def whole_image(corpus: Corpus, pair: int, eye: int, size_px: SizePx) -> tuple[Image, Boxes]:
    """An image without augmentation, as the detector's input, and its boxes."""
    canvas = np.full((*size_px, 3), PADDING_DN, dtype=np.uint8)
    view = whole_view(corpus.size_px[::-1], size_px[::-1])
    return canvas, paint_view(canvas, corpus.image(pair, eye), corpus.boxes(pair, eye), view)


def measure_batch_statistics(network: nn.Module, corpus: Corpus, size_px: SizePx, compute: ComputeDevice) -> None:
    """Replace a network's running means and variances by those over images of the split train.

    Args:
        network: in evaluation mode, and left so.
        corpus: with the images.
        size_px: (height, width) of the network's input.
        compute: device and precision.
    """
    layers = [module for module in network.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [layer.momentum for layer in layers]
    for layer in layers:
        layer.reset_running_stats()
        layer.momentum = None  # the plain mean over all batches
        layer.train()
    try:
        for images in statistics_batches(corpus, size_px, compute):
            with torch.inference_mode(), compute.autocast():
                network(images)
    finally:
        for layer, momentum in zip(layers, momenta, strict=True):
            layer.momentum = momentum
            layer.eval()


def statistics_batches(corpus: Corpus, size_px: SizePx, compute: ComputeDevice) -> Iterator[Tensor]:
    """(B, 3, H, W) images of the split train, spread evenly over all datasets and scenes."""
    members = [(int(pair), eye) for pair in corpus.split("train") for eye in (0, 1)]
    chosen = np.linspace(0, len(members) - 1, min(_STATISTICS_IMAGES, len(members))).astype(int)
    batches = -(-len(chosen) // _STATISTICS_BATCH)
    # Each batch takes images of all scenes, so that its variance includes that between scenes.
    for first in range(batches):
        group = [members[i] for i in chosen[first::batches]]
        images = np.stack([whole_image(corpus, pair, eye, size_px)[0] for pair, eye in group])
        yield to_tensor(images, compute)


@dataclass(frozen=True, eq=False)
class Predictions:
    """True and predicted boxes of N images, in corner coordinates of the network's input or of the corpus's images.

    Attributes:
        truth: N arrays (n, 4) of true boxes.
        found: N arrays (m, 4) of predicted boxes, the best first, with (m,) scores.
    """

    truth: list[Boxes]
    found: list[tuple[Boxes, Boxes]]


@dataclass(frozen=True)
class Search:
    """How a network searches images while it learns: once, and again at half the size.

    Attributes:
        size_px: (height, width) of the network's input.
        batch_images: number of images in a batch.
        large_from_px: boxes whose longer side is at least this come from a second pass at half the size; 0 for a single
            pass.
    """

    size_px: SizePx
    batch_images: int
    large_from_px: float


def predict(
    network: nn.Module,
    corpus: Corpus,
    split: SplitName,
    search: Search,
    compute: ComputeDevice,
    advance: Callable[[], None] = lambda: None,
) -> Predictions:
    """Run a network on the cached images of both eyes of a split, without augmentation.

    Small boxes are not looked at again, because the images show no more at a larger scale.

    Args:
        network: in evaluation mode.
        corpus: with the images.
        split: which of them.
        search: how the images are searched.
        compute: device and precision.
        advance: called after each batch.
    """
    members = [(int(pair), eye) for pair in corpus.split(split) for eye in (0, 1)]
    starts = range(0, len(members), search.batch_images)
    groups = [members[start : start + search.batch_images] for start in starts]
    truth: list[Boxes] = []
    found: list[tuple[Boxes, Boxes]] = []

    def read(group: Sequence[tuple[int, int]]) -> list[tuple[Image, Boxes]]:
        return [whole_image(corpus, pair, eye, search.size_px) for pair, eye in group]

    def run(images: Sequence[Image]) -> list[NDArray[Any]]:
        with torch.inference_mode(), compute.autocast():
            maps = network(to_tensor(np.stack(images), compute))
        return [each.float().cpu().numpy() for each in maps]

    for whole in prefetch_map(read, groups, threads=1, ahead=2):
        images, boxes = zip(*whole, strict=True)
        found += detect_multiscale(images, run, search.large_from_px, _MIN_SCORE, MAX_BOXES)
        truth += boxes
        advance()
    return Predictions(truth, found)


def detect_split(
    detector: OnnxDetector, corpus: Corpus, split: SplitName, advance: Callable[[], None] = lambda: None
) -> Predictions:
    """Run a detector on the pairs of a split as they were taken, and clip its boxes to the images, as in use.

    Pairs that can no longer be read are left out, and are faults of the corpus.

    Args:
        detector: of a file.
        corpus: with the pairs.
        split: which of them.
        advance: called after each pair.
    """
    pairs = [int(pair) for pair in corpus.split(split)]
    seen = Predictions([], [])
    for pair, images in zip(pairs, prefetch_map(corpus.stereo_images, pairs, threads=1, ahead=2), strict=True):
        if images is not None:
            candidates = detector.candidates(images, _MIN_SCORE)
            seen.found.extend(_in_corpus(candidates[eye], images.size_px, corpus.size_px[::-1]) for eye in EYES)
            seen.truth.extend(corpus.boxes(pair, eye) for eye in (0, 1))
        advance()
    return seen


def _in_corpus(
    detections: Sequence[Detection], image_size_px: tuple[int, int], cached_size_px: tuple[int, int]
) -> tuple[Boxes, Boxes]:
    """Boxes of an image as the corpus has its true ones, clipped to the image, and their scores.

    Args:
        detections: the best first.
        image_size_px, cached_size_px: width and height of the image as it was taken, and in the corpus.
    """
    placement = letterbox(image_size_px, cached_size_px)
    width, height = (round(scale * side) for scale, side in zip(placement.scale, image_size_px, strict=True))
    boxes = placement.to_input(np.array([one.box_xywh_px for one in detections]))
    clipped, fractions = clip_boxes(boxes, CanvasWindow(*placement.offset_px, width, height))
    scores = np.array([one.score for one in detections])
    return clipped[fractions > 0], scores[fractions > 0]


@dataclass(frozen=True)
class ValidationScores:
    """COCO's scores of a split, fractions from 0 to 1.

    Attributes:
        ap: average precision, mean over IoU thresholds from 0.5 to 0.95.
        ap50, ap75: average precision at one IoU threshold.
        recall50: recall at IoU 0.5 of all predictions, whatever their score.
    """

    ap: float
    ap50: float
    ap75: float
    recall50: float


def average_precision(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]]) -> ValidationScores | None:
    """Score predictions against the truth by pycocotools.

    Unlike the benchmark's, these scores have no ignored boxes, and count the best 10 boxes of an image.

    Args:
        truth: for each image (n, 4) boxes x, y, width, height.
        found: for each image (m, 4) boxes and (m,) scores.

    Returns:
        None where no image has a true box.
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
        results = [
            (image, *box, score, 1)
            for image, (own, scores) in enumerate(found, start=1)
            for box, score in zip(own.tolist(), scores.tolist(), strict=True)
        ]
        if not results:
            return ValidationScores(0.0, 0.0, 0.0, 0.0)
        evaluation = COCOeval(coco, coco.loadRes(np.array(results, dtype=np.float64)), "bbox")
        evaluation.params.maxDets = [1, MAX_BOXES, MAX_BOXES]
        evaluation.params.areaRng = [[0, 1e10]]
        evaluation.params.areaRngLbl = ["all"]
        evaluation.evaluate()
        evaluation.accumulate()
    # (IoU threshold, recall, class, area, largest number of boxes): the thresholds are 0.5, 0.55 to 0.95.
    precision = evaluation.eval["precision"][:, :, 0, 0, -1]
    ap50, ap75 = (float(precision[index].mean()) for index in (0, 5))
    return ValidationScores(float(precision.mean()), ap50, ap75, float(evaluation.eval["recall"][0, 0, 0, -1]))


def best_threshold(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]], otherwise: float) -> float:
    """The score threshold with the fewest errors, if the detector reports the best box of each image.

    Errors are wrong boxes and missed drogues. A wrong box in an image without a drogue counts three times, and has more
    weight the fewer such images there are, so that the rates matter and not how many of them a dataset has. Some
    hundred images do not determine one threshold: many differ from the best by no more than chance, and the middle of
    their range is taken.

    Args:
        truth: for each image (n, 4) boxes of all drogues in it.
        found: for each image (m, 4) boxes and (m,) scores, the best first.
        otherwise: the threshold where no prediction is right.

    Returns:
        The middle between the highest and the lowest of those thresholds.
    """
    best = [
        (float(scores[0]), len(own) > 0, bool((intersection_over_union(own, boxes[0]) >= _MIN_IOU).any()))
        for own, (boxes, scores) in zip(truth, found, strict=True)
        if len(scores)
    ]
    best.sort(key=lambda prediction: -prediction[0])
    right = np.cumsum([is_right for _, _, is_right in best])
    if not len(right) or right[-1] == 0:
        return otherwise
    shown = sum(len(own) > 0 for own in truth)
    # A missed drogue has the weight of a wrong box in an image with a drogue.
    weight = _FALSE_ALARM_WEIGHT * shown / max(len(truth) - shown, 1)
    false = np.cumsum([(1.0 if shows else weight) * (not is_right) for _, shows, is_right in best])
    wrong = (shown - right) + false
    # The standard deviation of a number of rare events is its square root.
    good = np.flatnonzero(wrong < max(wrong.min() + np.sqrt(wrong.min()), wrong.min() + 0.5))
    first, last = int(good[0]), int(good[-1])
    below = best[last + 1][0] if last + 1 < len(best) else 0.0
    return (best[first][0] + below) / 2
