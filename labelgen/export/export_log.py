"""What an export tells while it runs: how far it is, and what its format cannot hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from datasets_manifest.storage.layout import RECORD_FILE
from labelgen.export.record_consistency import record_fault

if TYPE_CHECKING:
    # The command's help lists the formats without loading what reads a dataset.
    from datasets_manifest.storage.reader import Dataset
    from datasets_manifest.types.records import PairRecord


class Progress(Protocol):
    """What counts the pairs for the user."""

    def begin(self, what: str, total: int) -> None:
        """`total` pieces of work of the kind `what` are about to start."""
        ...

    def advance(self) -> None:
        """One piece is finished."""
        ...

    def end(self) -> None:
        """The work that `begin` announced is over."""
        ...


class ExportLog:
    """Counts pairs for the user and, by reason, everything that was dropped, cut or changed."""

    def __init__(self, progress: Progress | None = None) -> None:
        self._progress = progress
        self._losses: Counter[str] = Counter()

    def records(self, source: Dataset) -> Iterator[PairRecord]:
        """The truth of all pairs in the order of their indices, one at a time.

        Raises:
            ValueError: a record that cannot be read or contradicts itself; names the file.
        """
        if self._progress is not None:
            self._progress.begin("pairs", len(source.frame_indices))
        for frame_index in source.frame_indices:
            record = source.record(frame_index)
            fault = record_fault(record)
            if fault is not None:
                raise ValueError(f"{source.frames.where(frame_index, RECORD_FILE)}: {fault}")
            yield record
            if self._progress is not None:
                self._progress.advance()

    def end(self) -> None:
        """The export is over, or has failed."""
        if self._progress is not None:
            self._progress.end()

    def lost(self, what: str, count: int = 1) -> None:
        """`count` more of `what` (plural, with the reason) are not in the export as they are in the dataset."""
        if count:
            self._losses[what] += count

    @property
    def losses(self) -> dict[str, int]:
        """How many of what, by name."""
        return dict(sorted(self._losses.items()))
