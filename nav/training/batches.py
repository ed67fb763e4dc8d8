"""Batches of augmented images; each is a function of the settings, the corpus and its number.

An epoch shows every training image once, in an order of its own. A mosaic shows one such image beside three that are
drawn at random.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import sample_generator
from nav.detector.input_image import PADDING_DN
from nav.training.corpus import Corpus, EyeIndex
from nav.training.geometric_augmentation import (
    TILES,
    Boxes,
    CanvasWindow,
    Image,
    ImageView,
    ViewRanges,
    paint_view,
    sample_mosaic,
    sample_view,
    whole_view,
)
from nav.training.photometric_augmentation import color_jitter, cutout, paint_distractors
from nav.training.prefetch_map import prefetch_map
from nav.training.training_settings import SizePx, TrainingSettings

_MOSAIC_FRACTION = 0.8  # of the images, in the steps with mosaic
_WHOLE_FRACTION = 0.25  # of the others: the whole image, as in the detector
# Scales are relative to that at which the image just fits the network's input.
_MOSAIC_RANGES = ViewRanges(scale=(0.4, 1.4), rotation_deg=4, flip_fraction=0.5)
_SINGLE_RANGES = ViewRanges(scale=(0.65, 1.5), rotation_deg=4, flip_fraction=0.5)
_AHEAD_BATCHES = 2


@dataclass(frozen=True, eq=False)
class Batch:
    """The images and boxes of one training step.

    Attributes:
        images: (B, H, W, 3) gamma-encoded red, green, blue; with both views the two eyes of a pair are neighbours.
        boxes: B arrays (n, 4), x, y of the low corner, width, height, from the corner of the image. [px]
    """

    images: NDArray[np.uint8]
    boxes: tuple[Boxes, ...]


class BatchMaker:
    """Makes the batch of any step of a training."""

    def __init__(self, corpus: Corpus, settings: TrainingSettings) -> None:
        self._corpus, self._settings = corpus, settings
        self._pairs = corpus.split("train")
        # A sample is the image of one eye, or those of both eyes of a pair.
        self._eyes = 2 if settings.views == "both" else 1
        self._samples_per_epoch = 2 * len(self._pairs) // self._eyes
        self._samples_per_batch = settings.batch_images // self._eyes

    def epoch_after(self, step: int) -> int:
        """Number of epochs that are complete before step number `step`."""
        return step * self._samples_per_batch // self._samples_per_epoch

    def batch(self, step: int) -> Batch:
        """The batch of a step, counted from 0."""
        images, boxes = [], []
        for number in range(step * self._samples_per_batch, (step + 1) * self._samples_per_batch):
            for image, own in self._sample(step, *divmod(number, self._samples_per_epoch)):
                images.append(image)
                boxes.append(own)
        return Batch(np.stack(images), tuple(boxes))

    def batches(self, steps: range, threads: int) -> Generator[Batch]:
        """The batches of steps in their order; threads make them ahead."""
        return prefetch_map(self.batch, steps, threads, threads + _AHEAD_BATCHES)

    def _sample(self, step: int, epoch: int, position: int) -> Iterator[tuple[Image, Boxes]]:
        """Augmented images and boxes of a sample, one eye or both."""
        settings = self._settings
        order = sample_generator(settings.seed, epoch, 0, "order").permutation(self._samples_per_epoch)
        rng = sample_generator(settings.seed, epoch, position, "geometry")
        first = int(order[position])
        is_mosaic = settings.mosaic_at(step) and rng.random() < _MOSAIC_FRACTION
        samples = [first, *rng.integers(self._samples_per_epoch, size=TILES - 1)] if is_mosaic else [first]
        # The first of the four may be in any corner.
        samples = [samples[tile] for tile in rng.permutation(len(samples))]
        members = [self._members(int(sample)) for sample in samples]
        size = settings.size_at(step)
        views = self._sample_views(rng, members, size, is_mosaic)
        for eye_number, of_eye in enumerate(zip(*members, strict=True)):
            # Both eyes have the same views, but each has its own light, noise, occluders and distractors.
            light = sample_generator(settings.seed, epoch, position, f"light {eye_number}")
            yield self._paint(light, list(of_eye), views, size)

    def _members(self, sample: int) -> list[tuple[int, EyeIndex]]:
        """Pair and eye of each image of a sample."""
        if self._eyes == 2:
            pair = int(self._pairs[sample])
            return [(pair, 0), (pair, 1)]
        return [(int(self._pairs[sample // 2]), sample % 2)]

    def _sample_views(
        self, rng: np.random.Generator, members: list[list[tuple[int, EyeIndex]]], size: SizePx, is_mosaic: bool
    ) -> list[ImageView]:
        source_wh, canvas_wh = self._corpus.size_px[::-1], size[::-1]
        # The view is drawn around the drogue also where only one eye sees it.
        boxes = [np.vstack([self._corpus.boxes(*member) for member in sample]) for sample in members]
        if is_mosaic:
            ranges = _MOSAIC_RANGES.on_canvas(source_wh, canvas_wh)
            return sample_mosaic(rng, [source_wh] * len(boxes), boxes, canvas_wh, ranges)
        if rng.random() < _WHOLE_FRACTION:
            return [whole_view(source_wh, canvas_wh)]
        ranges = _SINGLE_RANGES.on_canvas(source_wh, canvas_wh)
        return [sample_view(rng, source_wh, boxes[0], CanvasWindow(0, 0, *canvas_wh), ranges)]

    def _paint(
        self, rng: np.random.Generator, members: list[tuple[int, EyeIndex]], views: list[ImageView], size: SizePx
    ) -> tuple[Image, Boxes]:
        canvas = np.full((*size, 3), PADDING_DN, dtype=np.uint8)
        shown = [
            paint_view(canvas, self._corpus.image(*member), self._corpus.boxes(*member), view)
            for member, view in zip(members, views, strict=True)
        ]
        boxes = np.vstack(shown)
        paint_distractors(rng, canvas, boxes)
        boxes = cutout(rng, canvas, boxes)
        return color_jitter(rng, canvas), boxes
