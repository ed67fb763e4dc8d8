"""Progress reports of long work."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from droguekit.batch.progress import PlainProgress, TerminalProgress, duration


def test_a_log_gets_a_line_at_the_end_with_count_and_rate() -> None:
    stream = io.StringIO()
    progress = PlainProgress(stream)
    progress.begin("pairs", 3)
    for _ in range(3):
        progress.advance()
    progress.end()
    assert re.fullmatch(r"pairs: 3 of 3, [\d.]+ a minute\n", stream.getvalue())


def test_failures_and_memory_stand_beside_the_count() -> None:
    stream = io.StringIO()
    progress = PlainProgress(stream)
    progress.begin("pairs", 1)
    progress.note("2 repeated, workers hold 1.5 GiB")
    progress.advance()
    assert re.fullmatch(r"pairs: 1 of 1, [\d.]+ a minute, 2 repeated, workers hold 1\.5 GiB\n", stream.getvalue())


@pytest.mark.parametrize("width", [80, 200])
def test_a_bar_and_its_note_have_a_line_each(width: int) -> None:
    stream = io.StringIO()
    progress = TerminalProgress(Console(file=stream, force_terminal=True, width=width))
    progress.begin("pairs", 50000)
    for _ in range(2):
        progress.note("3 repeated, 1 left out, workers hold 12.5 GiB")
        progress.advance()
    progress.end()
    shown = re.split(r"[\r\n]+", re.sub(r"\x1b\[[\d;?]*[A-Za-z]", "", stream.getvalue()))
    assert max(map(len, shown)) <= width
    bars = [line for line in shown if line.startswith("pairs")]
    assert re.match(r"pairs .* 2/50000 [\d.]+ a minute, .* left", bars[-1])
    assert shown[shown.index(bars[-1]) + 1].rstrip() == "3 repeated, 1 left out, workers hold 12.5 GiB"


def test_a_terminal_shows_lines_as_they_are_beside_the_bar() -> None:
    stream = io.StringIO()
    progress = TerminalProgress(Console(file=stream, force_terminal=True, width=200))
    progress.begin("pairs", 2)
    progress.advance()
    progress.say("frame 3: [bold] is no markup here")
    progress.advance()
    progress.end()
    assert "frame 3: [bold] is no markup here" in stream.getvalue()
    assert "a minute" in stream.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (3725, "1 h 02 min")],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert duration(seconds) == text
