"""How far long work is: a bar with rate and time left on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from typing import Protocol, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

# A log gets a line at most this often, and always one at the end.
_LINE_EVERY_S = 10.0


class ProgressReport(Protocol):
    """What long work tells while it runs."""

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


class PlainProgress:
    """Lines on a stream that nobody watches live."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._what, self._total, self._done = "", 0, 0
        self._began_s = self._told_s = 0.0

    def begin(self, what: str, total: int) -> None:
        """Start counting."""
        self._what, self._total, self._done = what, total, 0
        self._began_s = self._told_s = time.monotonic()

    def advance(self) -> None:
        """Count one, and tell it when the last line is old or this was the last piece."""
        self._done += 1
        now_s = time.monotonic()
        if self._done < self._total and now_s - self._told_s < _LINE_EVERY_S:
            return
        self._told_s = now_s
        rate_per_s = self._done / max(now_s - self._began_s, 1e-9)
        left = "" if self._done == self._total else f", {duration((self._total - self._done) / rate_per_s)} left"
        self.say(f"{self._what}: {self._done} of {self._total}, {60 * rate_per_s:.1f} a minute{left}")

    def say(self, text: str) -> None:
        """Print the line."""
        print(text, file=self._stream, flush=True)

    def end(self) -> None:
        """Nothing to clear."""


class TerminalProgress:
    """A bar on a terminal."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._began_s, self._done = 0.0, 0

    def begin(self, what: str, total: int) -> None:
        """Draw the empty bar."""
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
        )
        self._task = self._progress.add_task(what, total=total, rate="")
        self._began_s, self._done = time.monotonic(), 0
        self._progress.start()

    def advance(self) -> None:
        """Move the bar by one."""
        if self._progress is not None:
            self._done += 1
            rate_per_min = 60 * self._done / max(time.monotonic() - self._began_s, 1e-9)
            self._progress.update(self._task, advance=1, rate=f"{rate_per_min:.1f} a minute")

    def say(self, text: str) -> None:
        """Print the line above the bar."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def end(self) -> None:
        """Remove the bar."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None


def progress_report() -> ProgressReport:
    """The report that suits where standard error goes."""
    if sys.stderr.isatty():
        return TerminalProgress(Console(stderr=True))
    return PlainProgress(sys.stderr)


def duration(seconds: float) -> str:
    """A length of time for people."""
    whole = round(seconds)
    if whole < 60:
        return f"{max(seconds, 0):.1f} s" if seconds < 9.95 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
