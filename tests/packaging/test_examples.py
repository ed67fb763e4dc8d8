"""The examples of the documentation run as they stand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
WRITTEN = {
    "change_a_recipe": ("plain.png", "near-and-grey.png"),
    "render_one_pair": ("pair.png",),
    "score_an_estimator": ("position-error.png", "own-estimator-pairs/manifest.json"),
    "training_loop": ("stream-cache/manifest.json",),
}

pytestmark = pytest.mark.mitsuba


def test_all_examples_are_known() -> None:
    assert {file.stem for file in EXAMPLES.glob("*.py")} == set(WRITTEN)


# The longer ones use what tests of their subjects use.
SLOW = {"change_a_recipe", "score_an_estimator", "training_loop"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in sorted(WRITTEN)]
)
def test_an_example_runs(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py")], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for file in WRITTEN[name]:
        assert (tmp_path / file).stat().st_size > 0
