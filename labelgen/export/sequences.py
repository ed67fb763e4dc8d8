"""Pairs in the order of time, for formats that hold sequences."""

from __future__ import annotations

from datasets_manifest.types.records import PairRecord

_LATEST_S = 2.0**31


def sequence_name(sequence_id: int | None) -> str:
    """Name of a sequence's file or folder; single pairs, which belong to none, share one."""
    return "single_pairs" if sequence_id is None else f"sequence_{sequence_id:04d}"


class SequenceOrder:
    """Checks, pair by pair, that times ascend and that no sequence comes back after another one began.

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
