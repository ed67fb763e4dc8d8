"""The training loop: batches of augmented images, optimizer steps, validation after each epoch, checkpoints.

A batch is a function of the settings, the corpus and its number. An epoch shows every training image once, in an order
of its own, unless some make way for hard ones. A mosaic shows one such image beside three that are drawn at random.
Where there are photographs without a drogue, they take the places of some of the three, and of some images alone. Into
some images a drogue of another one is pasted.
"""

from __future__ import annotations

import math
import multiprocessing
import multiprocessing.connection
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field
from functools import cached_property
from math import cos, pi
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from datasets_manifest.random_streams import sample_generator
from nav.detector.input_image import PADDING_DN
from nav.detector.network.head import DetectionLoss, LossWeights, detection_loss
from nav.training.augmentation import (
    SMALLEST_LEARNED_FRACTION,
    TILES,
    Boxes,
    CanvasWindow,
    Image,
    ImageView,
    ViewRanges,
    color_jitter,
    paint_view,
    sample_mosaic,
    sample_view,
    whole_view,
)
from nav.training.corpus import Corpus, EyeIndex
from nav.training.drogue_cutouts import (
    Paste,
    is_clear,
    paste_drogue,
    pasted_box,
    pasted_rectangle,
    sample_paste,
)
from nav.training.evaluation import (
    Search,
    ValidationScores,
    average_precision,
    measure_batch_statistics,
    predict,
    to_tensor,
)
from nav.training.painted_shapes import paint_distractors, paint_occluders
from nav.training.prefetch_map import prefetch_map
from nav.training.training_progress import VALIDATED, EpochRow, TensorBoardCurves, TrainingObserver, write_tables
from nav.training.training_settings import SizePx, TrainingSettings
from nav.training.training_state import BEST_FILE, ComputeDevice, TrainingState, save_checkpoint, save_state

_WHOLE_FRACTION = 0.25  # of the others: the whole image, as in the detector
# Scales are relative to that at which the image just fits the network's input.
_MOSAIC_RANGES = ViewRanges(scale=(0.4, 1.4), rotation_deg=4, flip_fraction=0.5)
_SINGLE_RANGES = ViewRanges(scale=(0.65, 1.5), rotation_deg=4, flip_fraction=0.5)
NO_PAIRS = np.zeros(0, dtype=np.int64)
_AHEAD_BATCHES = 2
_STEPS_PER_CURVE_POINT = 10
# Validation every third epoch before the last input size; the best weights are chosen among those at that size. In a
# training of many epochs, validation of each would take longer than the training.
_EPOCHS_PER_VALIDATION = 3
_MOST_VALIDATIONS = 20
_WORKER_ENDED = "DataLoader worker"  # in what torch says then
_LONGEST_END_S = 5.0  # from the end of a process's connections to its own


class Member(NamedTuple):
    """An image of a sample.

    Attributes:
        pair: or a photograph's number behind those of the pairs.
        eye: whose image.
        paste: of a drogue into it, or None.
    """

    pair: int
    eye: EyeIndex
    paste: Paste | None = None


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

    def __init__(self, corpus: Corpus, settings: TrainingSettings, hard_pairs: NDArray[np.int64] = NO_PAIRS) -> None:
        self._corpus, self._settings = corpus, settings
        self._pairs = corpus.split("train")
        # A sample is the image of one eye, or those of both eyes of a pair.
        self._eyes = 2 if settings.views == "both" else 1
        is_hard = np.isin(self._pairs, hard_pairs)
        self._hard_samples = np.flatnonzero(is_hard if self._eyes == 2 else np.repeat(is_hard, 2))
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

    def batches(self, steps: range, workers: int) -> Generator[Batch]:
        """The batches of steps in their order, made ahead by a thread, or by so many processes if more than one."""
        if workers == 1:
            return prefetch_map(self.batch, steps, 1, 1 + _AHEAD_BATCHES)
        return self._batches_of_processes(steps, workers)

    def _batches_of_processes(self, steps: range, workers: int) -> Generator[Batch]:
        loader = DataLoader(
            _BatchesByStep(self, steps),
            batch_size=None,
            collate_fn=lambda batch: batch,
            num_workers=workers,
            prefetch_factor=_AHEAD_BATCHES,
            # A forked process shares the images that are mapped into memory.
            multiprocessing_context="fork",
            # OpenCV's own threads do not survive a fork.
            worker_init_fn=lambda _: cv2.setNumThreads(0),
        )
        batches = iter(loader)
        processes = multiprocessing.active_children()
        try:
            for images, boxes in batches:
                yield Batch(images.numpy(), boxes)
        except (OSError, EOFError) as error:
            # A process that is killed loses its connections before it ends, and torch tells only of the end.
            ended = multiprocessing.connection.wait([process.sentinel for process in processes], _LONGEST_END_S)
            if not ended:
                raise
            for process in processes:
                if process.sentinel in ended:
                    process.join()
            raise RuntimeError(_WORKER_ENDED) from error

    def _sample(self, step: int, epoch: int, position: int) -> Iterator[tuple[Image, Boxes]]:
        """Augmented images and boxes of a sample, one eye or both."""
        settings = self._settings
        order = sample_generator(settings.seed, epoch, 0, "order").permutation(self._samples_per_epoch)
        rng = sample_generator(settings.seed, epoch, position, "geometry")
        first = int(order[position])
        if len(self._hard_samples) and rng.random() < settings.hard_fraction:
            first = int(rng.choice(self._hard_samples))
        is_mosaic = settings.mosaic_at(step) and rng.random() < settings.mosaic_fraction
        samples = [first, *rng.integers(self._samples_per_epoch, size=TILES - 1)] if is_mosaic else [first]
        # The first of the four may be in any corner.
        samples = [samples[tile] for tile in rng.permutation(len(samples))]
        members = [self._members(int(sample)) for sample in samples]
        if len(self._corpus.photographs):
            members = self._with_photographs(rng, members, samples.index(first))
        if len(self._corpus.pairs_to_cut):
            members = [self._with_pastes(rng, own) for own in members]
        size = settings.size_at(step)
        views = self._sample_views(rng, members, size, is_mosaic)
        for eye_number, of_eye in enumerate(zip(*members, strict=True)):
            # Both eyes have the same views, but each has its own light, noise, occluders and distractors.
            light = sample_generator(settings.seed, epoch, position, f"light {eye_number}")
            yield self._paint(light, list(of_eye), views, size)

    def _with_photographs(self, rng: np.random.Generator, members: list[list[Member]], kept: int) -> list[list[Member]]:
        """The same with some images replaced by photographs, but not that of place `kept` in a mosaic."""
        replaced = rng.random(len(members)) < self._settings.photograph_fraction
        chosen = self._corpus.photographs[rng.integers(len(self._corpus.photographs), size=len(members))]
        if len(members) > 1:
            replaced[kept] = False
        return [
            [Member(int(photograph), eye) for _, eye, _ in own] if is_replaced else own
            for own, is_replaced, photograph in zip(members, replaced, chosen, strict=True)
        ]

    def _with_pastes(self, rng: np.random.Generator, members: list[Member]) -> list[Member]:
        """The same image of each eye, some with a drogue of another pair pasted into it, at the same place."""
        corpus = self._corpus
        if rng.random() >= self._settings.pasted_fraction:
            return members
        pair = int(corpus.pairs_to_cut[rng.integers(len(corpus.pairs_to_cut))])
        paste = sample_paste(rng, pair, corpus.boxes(pair, 0)[0], corpus.size_px[::-1])
        for member in members:
            box, (cut, _) = corpus.boxes(pair, member.eye)[0], corpus.opacity(pair, member.eye)
            if not is_clear(pasted_rectangle(box, cut, paste), corpus.boxes(member.pair, member.eye)):
                return members
        return [member._replace(paste=paste) for member in members]

    def _members(self, sample: int) -> list[Member]:
        """Pair and eye of each image of a sample."""
        if self._eyes == 2:
            pair = int(self._pairs[sample])
            return [Member(pair, 0), Member(pair, 1)]
        return [Member(int(self._pairs[sample // 2]), sample % 2)]

    def _boxes(self, member: Member) -> Boxes:
        """The boxes of an image, that of a pasted drogue first, so that the view is drawn around it."""
        boxes, paste = self._corpus.boxes(member.pair, member.eye), member.paste
        if paste is None:
            return boxes
        source = self._corpus.boxes(paste.pair, member.eye)[0]
        return np.vstack([pasted_box(source, paste, self._corpus.size_px[::-1]), boxes])

    def _image(self, member: Member) -> Image:
        image = self._corpus.image(member.pair, member.eye)
        if member.paste is None:
            return image
        shown = member.paste.pair, member.eye
        box, cutout = self._corpus.boxes(*shown)[0], self._corpus.opacity(*shown)
        return paste_drogue(image, self._corpus.image(*shown), box, *cutout, member.paste)

    def _sample_views(
        self, rng: np.random.Generator, members: list[list[Member]], size: SizePx, is_mosaic: bool
    ) -> list[ImageView]:
        source_wh, canvas_wh = self._corpus.size_px[::-1], size[::-1]
        # The view is drawn around the drogue also where only one eye sees it.
        boxes = [np.vstack([self._boxes(member) for member in sample]) for sample in members]
        if is_mosaic:
            ranges = _MOSAIC_RANGES.on_canvas(source_wh, canvas_wh)
            return sample_mosaic(rng, [source_wh] * len(boxes), boxes, canvas_wh, ranges)
        if rng.random() < _WHOLE_FRACTION:
            return [whole_view(source_wh, canvas_wh)]
        ranges = _SINGLE_RANGES.on_canvas(source_wh, canvas_wh)
        return [sample_view(rng, source_wh, boxes[0], CanvasWindow(0, 0, *canvas_wh), ranges)]

    def _paint(
        self, rng: np.random.Generator, members: list[Member], views: list[ImageView], size: SizePx
    ) -> tuple[Image, Boxes]:
        canvas = np.full((*size, 3), PADDING_DN, dtype=np.uint8)
        shown = [
            paint_view(canvas, self._image(member), self._boxes(member), view, SMALLEST_LEARNED_FRACTION * size[0])
            for member, view in zip(members, views, strict=True)
        ]
        boxes = np.vstack(shown)
        paint_distractors(rng, canvas, boxes)
        boxes = paint_occluders(rng, canvas, boxes)
        return color_jitter(rng, canvas), boxes


class _BatchesByStep(Dataset[tuple[Tensor, tuple[Boxes, ...]]]):
    """The batches of a range of steps; images are tensors, which pass between processes without a copy."""

    def __init__(self, maker: BatchMaker, steps: range) -> None:
        self._maker, self._steps = maker, steps

    def __len__(self) -> int:
        return len(self._steps)

    def __getitem__(self, index: int) -> tuple[Tensor, tuple[Boxes, ...]]:
        batch = self._maker.batch(self._steps[index])
        return torch.from_numpy(batch.images), batch.boxes


def learning_rate(settings: TrainingSettings, step: int) -> float:
    """The learning rate of a step, counted from 0: a linear warm-up, then half a cosine."""
    warmup = round(settings.warmup_fraction * settings.steps)
    if step < warmup:
        return settings.learning_rate * (step + 1) / (warmup + 1)
    done = (step - warmup) / max(settings.steps - warmup, 1)
    floor = settings.floor_fraction
    return settings.learning_rate * (floor + (1 - floor) * (1 + cos(pi * done)) / 2)


def is_validation_due(settings: TrainingSettings, steps_done: int, epoch: int, last_steps_done: int) -> bool:
    """Whether the end of an epoch is followed by a validation: the last one is always.

    Args:
        settings: of the training.
        steps_done: number of steps so far.
        epoch: number of epochs so far.
        last_steps_done: number of steps before the last validation; 0 if there was none.
    """
    if steps_done >= settings.steps:
        return True
    if steps_done - last_steps_done < settings.steps / _MOST_VALIDATIONS:
        return False
    is_last_size = settings.final_size_px is None or settings.size_at(steps_done - 1) == settings.final_size_px
    return is_last_size or epoch % _EPOCHS_PER_VALIDATION == 0


@dataclass(frozen=True, eq=False)
class Trainer:
    """Runs a training in its folder.

    Attributes:
        corpus, settings: the data and the settings of the training.
        compute: device and precision.
        out: folder of checkpoint, tables and curves.
        observer: is informed of every step and epoch.
        should_stop: called after every step.
        hard_pairs: (n,) indices of pairs that take the place of others as often as `hard_fraction` says.
    """

    corpus: Corpus
    settings: TrainingSettings
    compute: ComputeDevice
    out: Path
    observer: TrainingObserver
    should_stop: Callable[[], bool]
    hard_pairs: NDArray[np.int64] = field(default_factory=lambda: NO_PAIRS)

    def run(self, state: TrainingState) -> None:
        """Train from a state to the end.

        Raises:
            ValueError: the loss is no longer finite.
            OSError: a file cannot be written, or a process that prepares images ended; the previous checkpoint stays.
            KeyboardInterrupt: `should_stop` returned true; the state is saved.
        """
        self.observer.begin(f"steps of {self.settings.batch_images} images", self.settings.steps - state.step)
        try:
            self._run(state)
        except RuntimeError as error:
            # Raised wherever the training is when the process ends.
            if _WORKER_ENDED not in str(error):
                raise
            raise OSError(
                "loader_workers: a process that prepares images was ended, perhaps for lack of memory; run the same "
                f"command again, with fewer than {self.settings.loader_workers}"
            ) from error
        finally:
            self.observer.end()

    def _run(self, state: TrainingState) -> None:
        settings, maker = self.settings, BatchMaker(self.corpus, self.settings, self.hard_pairs)
        curves = TensorBoardCurves(self.out, state.step * settings.batch_images)
        batches = maker.batches(range(state.step, settings.steps), settings.loader_workers)
        saved_s = began_s = time.monotonic()
        with closing(curves), closing(batches):
            for batch in batches:
                self._step(state, batch, curves)
                state.row_seconds += time.monotonic() - began_s
                self.observer.advance()
                is_stopped = self.should_stop()
                if maker.epoch_after(state.step) > maker.epoch_after(state.step - 1) or state.step == settings.steps:
                    self._end_epoch(state, maker.epoch_after(state.step), curves)
                    saved_s = time.monotonic()
                elif is_stopped or time.monotonic() - saved_s > 60 * settings.checkpoint_minutes:
                    self._save(state)
                    saved_s = time.monotonic()
                if is_stopped and state.step < settings.steps:
                    self.observer.say(
                        f"stopped after {state.step * settings.batch_images:,} images; the state is saved"
                    )
                    raise KeyboardInterrupt
                began_s = time.monotonic()

    def _step(self, state: TrainingState, batch: Batch, curves: TensorBoardCurves) -> None:
        rate = learning_rate(self.settings, state.step)
        loss = self._update_weights(state, batch, rate)
        total, score, box = (float(part.detach()) for part in loss)
        if not math.isfinite(total):
            raise ValueError(
                f"learning_rate: the loss became {total} at step {state.step}; train with a lower one than "
                f"{self.settings.learning_rate:g}, into another folder"
            )
        state.average.update(state.network, state.step)
        state.step += 1
        state.losses.append(total)
        state.parts.append((score, box))
        if state.step % _STEPS_PER_CURVE_POINT == 0:
            curves.add_step(state.step * self.settings.batch_images, total, score, box, rate)

    def _update_weights(self, state: TrainingState, batch: Batch, rate: float) -> DetectionLoss:
        for group in state.optimizer.param_groups:
            group["lr"] = rate
        state.network.train()
        boxes = [torch.from_numpy(own).float().to(self.compute.device) for own in batch.boxes]
        with self.compute.autocast():
            maps = state.network(to_tensor(batch.images, self.compute))
        settings = self.settings
        weights = LossWeights(settings.cells_per_box, settings.focus_power, settings.box_weight)
        loss = detection_loss(maps, boxes, weights)
        state.optimizer.zero_grad(set_to_none=True)
        loss.total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(state.network.parameters(), self.settings.gradient_norm)
        state.optimizer.step()
        return loss

    def _end_epoch(self, state: TrainingState, epoch: int, curves: TensorBoardCurves) -> None:
        """Validate, record and report the epoch, and save the state, and the weights if they are the best so far."""
        settings, size = self.settings, self.settings.size_at(state.step - 1)
        began_s = time.monotonic()
        stage = int(settings.final_size_px is not None and size == settings.final_size_px)
        validated = [row.image_passes // settings.batch_images for row in state.rows if row.ap is not None]
        is_due = is_validation_due(settings, state.step, epoch, validated[-1] if validated else 0)
        # The last one also fits the batch statistics.
        is_due = is_due and (self._can_validate or state.step >= settings.steps)
        validation = self._validate(state, size) if is_due else None
        row = self._row(state, epoch, validation)
        state.rows.append(row)
        # Of equally good weights the later ones have learned more, as where none find a drogue yet.
        if validation is not None and (stage, validation.ap) >= state.best:
            state.best = (stage, validation.ap)
            save_checkpoint(self.out / BEST_FILE, {"network": state.average.network.state_dict(), "step": state.step})
        per_step_s = (state.row_seconds + time.monotonic() - began_s) / len(state.parts)
        state.parts, state.row_seconds = [], 0.0
        curves.add_epoch(row)
        self._save(state)
        left_s = (settings.steps - state.step) * per_step_s
        self.observer.say(row.to_line(settings.steps * settings.batch_images, left_s))

    @cached_property
    def _can_validate(self) -> bool:
        """Whether the split `val` shows a drogue, without which there is no average precision."""
        return any(len(self.corpus.boxes(pair, eye)) for pair in self.corpus.split("val") for eye in (0, 1))

    def _validate(self, state: TrainingState, size: SizePx) -> ValidationScores | None:
        network = state.average.network
        measure_batch_statistics(network, self.corpus, size, self.compute)
        settings = self.settings
        search = Search(size, settings.batch_images, settings.large_from_px)
        predictions = predict(network, self.corpus, "val", search, self.compute)
        return average_precision(predictions.truth, predictions.found)

    def _row(self, state: TrainingState, epoch: int, validation: ValidationScores | None) -> EpochRow:
        settings = self.settings
        height_px, width_px = settings.size_at(state.step - 1)
        count = len(state.parts)
        return EpochRow(
            epoch=epoch,
            image_passes=state.step * settings.batch_images,
            height_px=height_px,
            width_px=width_px,
            loss=sum(state.losses[-count:]) / count,
            score_loss=sum(score for score, _ in state.parts) / count,
            box_loss=sum(box for _, box in state.parts) / count,
            learning_rate=learning_rate(settings, state.step - 1),
            images_per_s=count * settings.batch_images / max(state.row_seconds, 1e-9),
            **(dict.fromkeys(VALIDATED) if validation is None else asdict(validation)),
        )

    def _save(self, state: TrainingState) -> None:
        write_tables(self.out, state.rows, state.losses, self.settings.batch_images)
        save_state(self.out, state, self.settings, self.corpus.datasets)
