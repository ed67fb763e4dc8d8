"""A file of estimates is always a whole one, whoever writes it and however the writing ends."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.types.estimates import NoFix, PoseEstimate, read_estimates, write_estimates
from geometry.se3 import RigidTransform


def dark(method: str, count: int) -> list[NoFix]:
    return [NoFix(frame_index=index, method=method, reason="dark") for index in range(count)]


def test_two_writers_at_once_do_not_mix(tmp_path: Path) -> None:
    """One writes its whole file while another one is in the middle of its own."""
    path = tmp_path / "e.jsonl"

    def with_another_in_between() -> Iterator[NoFix]:
        first, last = dark("slow", 2)
        yield first
        assert write_estimates(path, dark("quick", 3)) == 3
        assert list(read_estimates(path)) == dark("quick", 3)
        yield last

    assert write_estimates(path, with_another_in_between()) == 2
    assert list(read_estimates(path)) == dark("slow", 2)
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_there_outlives_an_interrupted_writer(tmp_path: Path) -> None:
    path = tmp_path / "e.jsonl"
    write_estimates(path, dark("old", 2))

    def interrupted() -> Iterator[NoFix]:
        yield from dark("new", 1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_estimates(path, interrupted())
    assert list(read_estimates(path)) == dark("old", 2)
    assert list(tmp_path.iterdir()) == [path]


def test_a_note_is_kept_and_an_empty_one_is_left_out(tmp_path: Path) -> None:
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 5.0]))
    path = tmp_path / "e.jsonl"
    notes = ["", "no hub was measured"]
    write_estimates(
        path,
        [
            PoseEstimate(frame_index=index, method="m", left_from_drogue=pose, note=note)
            for index, note in enumerate(notes)
        ],
    )
    plain, noted = path.read_text(encoding="utf-8").splitlines()
    assert '"note"' not in plain and '"note":"no hub was measured"' in noted
    assert [estimate.note for estimate in read_estimates(path) if isinstance(estimate, PoseEstimate)] == notes


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=r"file/e\.jsonl: cannot be written"):
        write_estimates(tmp_path / "file" / "e.jsonl", dark("m", 1))
