"""Progress of long work: a bar with rate and time left on a terminal, plain lines otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from typing import Protocol, TextIO

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from rich.text import Text

from droguekit.output_streams import printable, terminal_stream

# Shortest time between two lines of a log, which always gets one at the end.
_LINE_EVERY_S = 10.0


class ProgressReport(Protocol):
    """Where long work reports its progress."""

    def begin(self, what: str, total: int) -> None:
        """Start counting `total` pieces of work, called `what`."""
        ...

    def advance(self) -> None:
        """Count one finished piece."""
        ...

    def note(self, text: str) -> None:
        """Show a text beside the count from the next piece on, such as failures so far; empty for none."""
        ...

    def say(self, text: str) -> None:
        """Print a line for the user."""
        ...

    def end(self) -> None:
        """Stop counting."""
        ...


class PlainProgress:
    """Progress as lines, for logs."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._what, self._note = "", ""
        self._pace = ProgressRate(0)
        self._told_s = 0.0

    def begin(self, what: str, total: int) -> None:
        """Start counting."""
        self._what, self._note, self._pace = what, "", ProgressRate(total)
        self._told_s = time.monotonic()

    def advance(self) -> None:
        """Count one, and print a line if the last one is old or this was the last piece."""
        self._pace.advance()
        now_s = time.monotonic()
        if self._pace.done < self._pace.total and now_s - self._told_s < _LINE_EVERY_S:
            return
        self._told_s = now_s
        count = f"{self._what}: {self._pace.done} of {self._pace.total}"
        self.say(", ".join(filter(None, (count, self._pace.rate(), self._pace.time_left(), self._note))))

    def note(self, text: str) -> None:
        """Keep it for the next line."""
        self._note = text

    def say(self, text: str) -> None:
        """Print the line."""
        print(printable(text), file=self._stream, flush=True)

    def end(self) -> None:
        """Nothing to clear."""


class _BarWithNote(Progress):
    """A progress bar with a line of text below."""

    note = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        """The bar and the note."""
        yield from super().get_renderables()
        if self.note:
            yield Text(self.note, no_wrap=True, overflow="ellipsis")


class TerminalProgress:
    """Progress as a bar on a terminal, with the note on a line of its own for narrow terminals."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress: _BarWithNote | None = None
        self._task = TaskID(0)
        self._pace = ProgressRate(0)

    def begin(self, what: str, total: int) -> None:
        """Draw the empty bar."""
        self._progress = _BarWithNote(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),  # takes the rest of the line
            MofNCompleteColumn(),
            TextColumn("{task.fields[pace]}", markup=False),
            console=self._console,
            transient=True,
            expand=True,
        )
        self._task = self._progress.add_task(what, total=total, pace="")
        self._pace = ProgressRate(total)
        self._progress.start()

    def advance(self) -> None:
        """Move the bar by one."""
        if self._progress is not None:
            self._pace.advance()
            pace = ", ".join(filter(None, (self._pace.rate(), self._pace.time_left())))
            self._progress.update(self._task, advance=1, pace=pace)

    def note(self, text: str) -> None:
        """Show it below the bar."""
        if self._progress is not None:
            self._progress.note = printable(text)

    def say(self, text: str) -> None:
        """Print the line above the bar."""
        self._console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def end(self) -> None:
        """Remove the bar."""
        if self._progress is not None:
            self._progress.stop()
            self._progress = None


class ProgressRate:
    """Rate of equal pieces of work, by the monotonic clock."""

    def __init__(self, total: int) -> None:
        self.total, self.done = total, 0
        self._began_s = time.monotonic()

    def advance(self) -> None:
        """One piece is finished."""
        self.done += 1

    def rate(self) -> str:
        """Pieces a minute."""
        return f"{60 * self._per_second():.1f} a minute"

    def time_left(self) -> str:
        """Time left at the rate so far; empty when everything is finished."""
        left = self.total - self.done
        return f"{duration(left / self._per_second())} left" if left else ""

    def _per_second(self) -> float:
        return self.done / max(time.monotonic() - self._began_s, 1e-9)


def progress_report() -> ProgressReport:
    """A bar if standard error is a terminal, else lines."""
    if sys.stderr.isatty():
        return TerminalProgress(Console(file=terminal_stream()))
    return PlainProgress(sys.stderr)


def duration(seconds: float) -> str:
    """A length of time as text."""
    whole = round(seconds)
    if whole < 60:
        return f"{max(seconds, 0):.1f} s" if seconds < 9.95 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def human_size(size_bytes: float) -> str:
    """A size in bytes as text."""
    for unit in ("B", "kB", "MB", "GB"):
        if size_bytes < 1000:
            return f"{size_bytes:.0f} {unit}" if unit == "B" else f"{size_bytes:.3g} {unit}"
        size_bytes /= 1000
    return f"{size_bytes:.3g} TB"
