"""Shared by all exports: progress, the log of what a format cannot hold, consistency of records, order in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from datasets_manifest.storage.layout import RECORD_FILE
from datasets_manifest.storage.pair_faults import PairFaults, read_or_note

if TYPE_CHECKING:
    # The command's help lists the formats without loading what reads a dataset.
    from datasets_manifest.storage.reader import Dataset
    from datasets_manifest.types.records import PairRecord, PixelBox, ViewRecord
    from geometry.pinhole import PinholeCamera
    from geometry.stereo import StereoRig


_LARGEST_ID = 2**63 - 1

_LATEST_S = 2.0**31


class Progress(Protocol):
    """A progress display."""

    def begin(self, what: str, total: int) -> None:
        """Begin a task of `total` steps with the unit `what`."""
        ...

    def advance(self) -> None:
        """Finish one step."""
        ...

    def end(self) -> None:
        """End the task."""
        ...


class ExportLog:
    """Reports progress and counts, by reason, everything that an export drops, cuts or changes.

    Attributes:
        remarks: what whoever reads the export has to know and the format cannot say, a line each.
        faults: count damaged pairs, which are left out; None where such a pair is an error.
    """

    def __init__(self, progress: Progress | None = None, faults: PairFaults | None = None) -> None:
        self._progress = progress
        self._losses: Counter[str] = Counter()
        self.remarks: list[str] = []
        self.faults = faults

    def records(self, source: Dataset, with_files: bool = True) -> Iterator[PairRecord]:
        """The records of all pairs in the order of their indices, one at a time.

        Where `faults` counts damaged pairs, what the export reads of a pair is compared with its hashes before it is
        given: a format's files are written pair by pair, and half a pair would be worse than none.

        Args:
            source: the dataset.
            with_files: whether the export reads more of a pair than its record.

        Raises:
            ValueError: a record that cannot be read or contradicts itself, and nothing counts faults, or no pair is
                whole; names the file.
        """

        def read(frame_index: int) -> PairRecord:
            if self.faults is None:
                record = source.record(frame_index)
            else:
                record = (source.checked_record if with_files else source.unchanged_record)(frame_index)
            fault = record_fault(record)
            if fault is not None:
                raise ValueError(f"{source.frames.where(frame_index, RECORD_FILE)}: {fault}")
            return record

        if self._progress is not None:
            self._progress.begin("pairs", len(source.frame_indices))
        for frame_index in source.frame_indices:
            record = read_or_note(frame_index, read, self.faults)
            if record is not None:
                yield record
            if self._progress is not None:
                self._progress.advance()
        first = None if self.faults is None else self.faults.first
        if first is not None and self.faults is not None and self.faults.count == len(source.frame_indices):
            raise ValueError(first[1])

    def end(self) -> None:
        """End the progress display, after success or failure."""
        if self._progress is not None:
            self._progress.end()

    def lost(self, what: str, count: int = 1) -> None:
        """Count `count` more of `what` (plural, with the reason), which the export lacks or changes."""
        if count:
            self._losses[what] += count

    def remark(self, line: str) -> None:
        """Add a remark once."""
        if line not in self.remarks:
            self.remarks.append(line)

    @property
    def losses(self) -> dict[str, int]:
        """Counts by reason, sorted by name."""
        return dict(sorted(self._losses.items()))


def require_pinholes(dataset: object, rig: StereoRig, name: str) -> None:
    """Check that a format for images of pinholes can hold those of a rig.

    Raises:
        ValueError: the rig has real lenses; names formats that hold their images and poses.
    """
    if rig.lenses is not None:
        raise ValueError(
            f"{dataset}: has images of real lenses, and {name} holds those of pinholes only; use speed or rosbag"
        )


def record_fault(record: PairRecord) -> str | None:
    """The first contradiction within a record, or None; `droguekit validate` checks more, also against pixels."""
    if max(record.scene_id, record.sequence_id or 0) > _LARGEST_ID:
        return f"scene_id, sequence_id: must be at most {_LARGEST_ID}"
    angles = (record.pitch_deg, record.yaw_deg, record.roll_deg, record.roll_modulo_deg)
    for value in (record.left_from_drogue, *angles):
        if (value is None) != (record.frame.drogue is None):
            return "left_from_drogue, angles: must be given exactly when the frame has a drogue"
    for eye, view in (("left", record.views.left), ("right", record.views.right)):
        fault = _view_fault(record, view)
        if fault is not None:
            return f"views.{eye}.{fault}"
    return None


def _view_fault(record: PairRecord, view: ViewRecord) -> str | None:
    drogue, camera = record.frame.drogue, record.frame.rig.camera
    count = 0 if drogue is None else drogue.marker_count
    if len(view.markers) != count:
        return f"markers: must be {count} as the frame's drogue has, got {len(view.markers)}"
    if (view.hub is None) != (drogue is None or drogue.hub is None):
        return "hub: must be given exactly when the frame's drogue has one"
    if (view.box_full_xywh_px is None) != (drogue is None):
        return "box_full_xywh_px: must be given exactly when the frame has a drogue"
    if (view.box_visible_xywh_px is None) != (view.visible_drogue_px == 0) or (
        drogue is None and view.visible_drogue_px
    ):
        return "box_visible_xywh_px: must be given exactly when pixels of a drogue are visible"
    if view.box_visible_xywh_px is not None and not _is_pixels(view.box_visible_xywh_px, camera):
        return f"box_visible_xywh_px: must be around whole pixels of the image, got {view.box_visible_xywh_px}"
    if len(view.neighbours) != len(record.frame.neighbours):
        return f"neighbours: must be {len(record.frame.neighbours)} as in the frame, got {len(view.neighbours)}"
    for index, other in enumerate(view.neighbours):
        box = other.box_visible_xywh_px
        if (box is None) != (other.visible_drogue_px == 0):
            return f"neighbours[{index}].box_visible_xywh_px: must be given exactly when pixels of it are visible"
        if box is not None and not _is_pixels(box, camera):
            return f"neighbours[{index}].box_visible_xywh_px: must be around whole pixels of the image, got {box}"
    if view.visible_drogue_px > camera.width_px * camera.height_px:
        return f"visible_drogue_px: is more than the image has, got {view.visible_drogue_px}"
    return None


def _is_pixels(box: PixelBox, camera: PinholeCamera) -> bool:
    u, v, width, height = box[0] + 0.5, box[1] + 0.5, box[2], box[3]
    return (
        all(number.is_integer() for number in (u, v, width, height))
        and min(u, v) >= 0
        and min(width, height) >= 1
        and u + width <= camera.width_px
        and v + height <= camera.height_px
    )


def sequence_name(sequence_id: int | None) -> str:
    """Name of a sequence's file or folder; all single pairs share one."""
    return "single_pairs" if sequence_id is None else f"sequence_{sequence_id:04d}"


class SequenceOrder:
    """Checks, pair by pair, that times ascend and that sequences do not interleave.

    Attributes:
        is_first: whether the last pair began a sequence.
    """

    def __init__(self) -> None:
        self.is_first = True
        self._ended: set[int | None] = set()
        self._last: tuple[int | None, int] | None = None

    def stamp_ns(self, record: PairRecord) -> int:
        """Mid-exposure of the next pair. [ns]

        Raises:
            ValueError: it is not later than the last one of its sequence, or its sequence had ended.
        """
        name = f"frame {record.frame_index}"
        if not 0 <= record.time_s < _LATEST_S:
            raise ValueError(f"{name}: time_s: must be in [0, 2^31) for a time stamp, got {record.time_s:g}")
        stamp_ns = round(record.time_s * 1e9)
        self.is_first = self._last is None or record.sequence_id != self._last[0]
        if self._last is not None:
            if self.is_first:
                self._ended.add(self._last[0])
            elif stamp_ns <= self._last[1]:
                raise ValueError(f"{name}: time_s: must be later than the pair's before it, got {record.time_s:g}")
        if record.sequence_id in self._ended:
            raise ValueError(f"{name}: sequence_id: {record.sequence_id} had ended before; pairs are out of order")
        self._last = record.sequence_id, stamp_ns
        return stamp_ns
