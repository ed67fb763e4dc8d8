"""What a training reports: progress to its observer, a row of results for each epoch, tables, TensorBoard curves."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Protocol

from datasets_manifest.atomic import write_text_atomic

VALIDATED = ("ap", "ap50", "ap75", "recall50")
HISTORY_FILE, LOSSES_FILE, TENSORBOARD_FOLDER = "history.csv", "losses.csv", "tensorboard"


@dataclass(frozen=True)
class EpochRow:
    """Results of one epoch.

    Attributes:
        epoch: number of complete epochs; the last row may be of a part of one.
        image_passes: number of images that have passed through the network so far.
        height_px, width_px: of the network's input.
        loss, score_loss, box_loss: means over the epoch's steps.
        learning_rate: of its last step.
        images_per_s: of training, without validation.
        ap, ap50, ap75, recall50: on the validation split with the averaged weights; None where not measured.
    """

    epoch: int
    image_passes: int
    height_px: int
    width_px: int
    loss: float
    score_loss: float
    box_loss: float
    learning_rate: float
    images_per_s: float
    ap: float | None
    ap50: float | None
    ap75: float | None
    recall50: float | None

    def to_line(self, image_passes: int, time_left_s: float) -> str:
        """The row as a line of text.

        Args:
            image_passes: of the whole training.
            time_left_s: expected time until it ends. [s]
        """
        validation = (
            "no validation"
            if self.ap is None or self.ap50 is None
            else f"val AP50 {100 * self.ap50:5.1f}, AP {100 * self.ap:5.1f}"
        )
        return (
            f"epoch {self.epoch:3d}: {self.image_passes:,} of {image_passes:,} images at "
            f"{self.height_px}x{self.width_px}, loss {self.loss:.3f} (score {self.score_loss:.3f}, box "
            f"{self.box_loss:.3f}), {validation}, {self.images_per_s:.1f} images/s, {_duration(time_left_s)} left"
        )


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{round(seconds)} s" if minutes < 2 else f"{minutes // 60} h {minutes % 60:02d} min"


def write_tables(out: Path, rows: Sequence[EpochRow], losses: Sequence[float], batch_images: int) -> None:
    """Write `history.csv`, a row an epoch, and `losses.csv`, a row a step.

    Raises:
        OSError: one cannot be written.
    """
    text = io.StringIO()
    table = csv.DictWriter(text, [field.name for field in fields(EpochRow)], lineterminator="\n")
    table.writeheader()
    table.writerows(asdict(row) for row in rows)
    write_text_atomic(out / HISTORY_FILE, text.getvalue())
    lines = [f"{(step + 1) * batch_images},{loss!r}\n" for step, loss in enumerate(losses)]
    write_text_atomic(out / LOSSES_FILE, "".join(["image_passes,loss\n", *lines]))


class TensorBoardCurves:
    """The curves of a training for TensorBoard."""

    def __init__(self, out: Path, image_passes: int) -> None:
        """Continue after `image_passes` images; later points, of a run that was killed, are hidden."""
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(out / TENSORBOARD_FOLDER), purge_step=image_passes + 1)

    def add_step(self, image_passes: int, loss: float, score: float, box: float, learning_rate: float) -> None:
        """Add one step's point to each curve."""
        values = {"loss": loss, "score": score, "box": box, "learning_rate": learning_rate}
        for name, value in values.items():
            self._writer.add_scalar(f"train/{name}", value, image_passes)

    def add_epoch(self, row: EpochRow) -> None:
        """Add one epoch's validation scores."""
        for name in VALIDATED:
            value = getattr(row, name)
            if value is not None:
                self._writer.add_scalar(f"val/{name}", value, row.image_passes)
        self._writer.flush()

    def close(self) -> None:
        """Write all remaining points."""
        self._writer.close()


class TrainingObserver(Protocol):
    """Receives the progress of a training."""

    def begin(self, what: str, total: int) -> None:
        """A task of `total` steps, described by `what`, begins."""
        ...

    def advance(self) -> None:
        """One step is finished."""
        ...

    def say(self, text: str) -> None:
        """Show a line to the user."""
        ...

    def end(self) -> None:
        """The task that `begin` announced has ended."""
        ...
