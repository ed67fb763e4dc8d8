"""Detectors on two engines' pictures of the same frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from datasets_manifest.storage.reader import Dataset
from studies.engine_agreement.detection_agreement import main


@pytest.mark.slow
def test_both_engines_draw_the_same_frames_and_stand_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(tmp_path, ["mobile-s"], ("mitsuba", "analytic"), recipe="smoke", pairs=1)
    one, other = Dataset(tmp_path / "mitsuba"), Dataset(tmp_path / "analytic")
    poses = [dataset.record(0).frame.left_from_drogue for dataset in (one, other)]
    assert all(pose is not None for pose in poses) and str(poses[0]) == str(poses[1])
    assert (one.manifest.recipe.render.engine, other.manifest.recipe.render.engine) == ("mitsuba", "analytic")
    lines = capsys.readouterr().out.strip().splitlines()
    assert lines[0] == "mobile-s"
    assert lines[2].startswith("| drogue | images | drogues | mitsuba: AP50, recall | false boxes | analytic: AP50")
    # Each has the two images' drogue, and found it with some score.
    assert lines[-2].startswith("| ring | 2 | 2 | 100.0 %, ") and lines[-2].count(" 100.0 %, ") == 2


def test_too_few_frames_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(tmp_path, recipe="smoke", pairs=10_000)
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("detection_agreement: error: frames: ")
