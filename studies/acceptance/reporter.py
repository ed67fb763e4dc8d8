"""What long work tells while it runs."""

from __future__ import annotations

from typing import Protocol


class Reporter(Protocol):
    """The part of a progress report that the bars use."""

    def begin(self, what: str, total: int) -> None:
        """`total` pieces of work of the kind `what` are about to start."""
        ...

    def advance(self) -> None:
        """One piece is finished."""
        ...

    def say(self, text: str) -> None:
        """A line for the user."""
        ...

    def end(self) -> None:
        """The work that `begin` announced is over."""
        ...
