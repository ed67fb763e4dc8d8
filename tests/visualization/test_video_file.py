"""How long a video shows each pair, and whether it says that this is not the time of the flight."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from droguekit.visualization.video_file import WrittenVideo, write_pairs

PICTURE = np.zeros((8, 8, 3), np.uint8)


def written(folder: Path, *sequences: list[float]) -> WrittenVideo:
    """A video of sequences with pairs at such times; other fields of a record do not count."""
    records: Any = [
        SimpleNamespace(sequence_id=sequence_id, time_s=time_s)
        for sequence_id, times in enumerate(sequences)
        for time_s in times
    ]
    video = write_pairs(folder / "video.gif", [PICTURE + 10 * place for place in range(len(records))], records)
    with Image.open(folder / "video.gif") as movie:
        assert movie.info["duration"] == pytest.approx(1000 * video.length_s / video.pairs)
    return video


def test_pairs_follow_each_other_as_they_flew(tmp_path: Path) -> None:
    video = written(tmp_path, [0.0, 1.0, 2.0])
    assert video == WrittenVideo(pairs=3, length_s=3.0, pace=1.0) and video.pace_text == ""


def test_pairs_that_are_far_apart_are_shown_faster_and_it_is_said(tmp_path: Path) -> None:
    video = written(tmp_path, [0.0, 9.0, 18.0])
    assert video.length_s == 6.0 and video.pace_text == ", 4.5 times as fast as it flew"


@pytest.mark.parametrize(("pace", "text"), [(1.02, ""), (1.5, "1.5"), (123.0, "120"), (2400.0, "2400")])
def test_a_pace_is_told_in_two_figures(pace: float, text: str) -> None:
    told = WrittenVideo(pairs=2, length_s=4.0, pace=pace).pace_text
    assert told == (text and f", {text} times as fast as it flew")


def test_the_step_from_one_sequence_to_the_next_does_not_count(tmp_path: Path) -> None:
    """Every sequence has a clock of its own, which starts again."""
    assert written(tmp_path, [0.0, 0.5], [0.0, 0.5], [30.0, 30.5]) == WrittenVideo(pairs=6, length_s=3.0, pace=1.0)


def test_one_pair_of_each_sequence_is_a_slide_show(tmp_path: Path) -> None:
    assert written(tmp_path, [3.0], [5.0]) == WrittenVideo(pairs=2, length_s=1.0, pace=1.0)
