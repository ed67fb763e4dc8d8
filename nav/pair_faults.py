"""Faults that end the work on one pair and not the run: their reasons, and their traces for whoever looks for a bug."""

from __future__ import annotations

import logging

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
    """Counts the pairs whose work ended by a fault.

    Attributes:
        count: how many there were.
        first: number of the first such pair and its fault; None where there was none.
    """

    def __init__(self) -> None:
        """Start without faults."""
        self.count = 0
        self.first: tuple[int, str] | None = None

    def note(self, frame_index: int, fault: str) -> None:
        """Count a pair."""
        self.count += 1
        self.first = (frame_index, fault) if self.first is None else self.first

    def line(self) -> str | None:
        """The faults in one line; None where there was none."""
        if self.first is None:
            return None
        pairs = "1 pair has" if self.count == 1 else f"{self.count} pairs have"
        hint = "; --debug shows the trace" if self.first[1].startswith("internal fault") else ""
        return f"{pairs} no result by a fault, first pair {self.first[0]}: {self.first[1]}{hint}"
