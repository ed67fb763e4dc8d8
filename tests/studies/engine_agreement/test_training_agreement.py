"""What is learned from two engines' pictures of the same frames, at toy size."""

from __future__ import annotations

from pathlib import Path

import pytest

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from studies.engine_agreement.training_agreement import main
from studies.world_variety.light_sheets import LIGHTS_RECIPE


@pytest.mark.slow
def test_both_engines_pictures_are_learned_from_and_stand_side_by_side(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    test = load_recipe(str(LIGHTS_RECIPE), render={"engine": "analytic"}, frames={"count": 2})
    render_dataset(test, tmp_path / "test", workers=0)
    main(tmp_path / "out", tmp_path / "test", ("mitsuba", "analytic"), "smoke", pairs=4, image_passes=8, seed=[3])
    lines = capsys.readouterr().out.strip().splitlines()
    assert lines[0] == "seed 3"
    assert "| by mitsuba: AP50, recall | false boxes | by analytic: AP50, recall |" in lines[2]
    assert lines[-2].startswith("| all | 4 | ") and lines[-1].startswith("AP of all: by mitsuba ")


def test_too_few_frames_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(tmp_path, tmp_path / "test", recipe="smoke", pairs=10_000)
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("training_agreement: error: frames: ")
