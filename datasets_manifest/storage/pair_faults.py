"""Faults that end the work on one pair and not the run: their reasons, and their traces for whoever looks for a bug."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

Read = TypeVar("Read")
_LOGGER = logging.getLogger(__name__)
_MOST_CHARACTERS = 300


def fault_reason(frame_index: int, error: Exception) -> str:
    """An exception of our own code within a pair as one line; `droguekit --debug` also shows its trace.

    Args:
        frame_index: of the pair.
        error: the exception that is being handled.
    """
    _LOGGER.debug("pair %d", frame_index, exc_info=error)
    text = " ".join(str(error).split())[:_MOST_CHARACTERS]
    return f"internal fault, {type(error).__name__}: {text}" if text else f"internal fault, {type(error).__name__}"


def unreadable_reason(frame_index: int, error: Exception) -> str:
    """An error of reading a pair as one line that names the file."""
    _LOGGER.debug("pair %d", frame_index, exc_info=error)
    return " ".join(str(error).split()) or type(error).__name__


class PairFaults:
    """Counts the pairs whose work ended by a fault."""

    def __init__(self) -> None:
        """Start without faults."""
        self._faults: dict[int, str] = {}

    @property
    def count(self) -> int:
        """How many pairs there were."""
        return len(self._faults)

    @property
    def first(self) -> tuple[int, str] | None:
        """Number of the first such pair and its fault; None where there was none."""
        return next(iter(self._faults.items()), None)

    def note(self, frame_index: int, fault: str) -> None:
        """Count a pair, at its first fault."""
        self._faults.setdefault(frame_index, fault)

    def line(self) -> str | None:
        """The faults in one line; None where there was none."""
        if self.first is None:
            return None
        pairs = "1 pair has" if self.count == 1 else f"{self.count} pairs have"
        hint = "; --debug shows the trace" if self.first[1].startswith("internal fault") else ""
        return f"{pairs} no result by a fault, first pair {self.first[0]}: {self.first[1]}{hint}"


def read_or_note(frame_index: int, read: Callable[[int], Read], faults: PairFaults | None) -> Read | None:
    """What a reader gives for a pair; None, and a fault that is noted, where the pair is damaged.

    Args:
        frame_index: of the pair.
        read: raises ValueError with the name of the file where the pair cannot be read.
        faults: that count it; None lets the error pass.

    Raises:
        ValueError: the pair cannot be read, and nothing counts faults.
    """
    if faults is None:
        return read(frame_index)
    try:
        return read(frame_index)
    except ValueError as error:
        faults.note(frame_index, unreadable_reason(frame_index, error))
        return None
