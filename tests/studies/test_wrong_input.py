"""Studies end with one line and the exit code of wrong input where options or files are wrong."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from droguekit.cli.main import WRONG_INPUT
from studies.drawn_cameras import __main__ as drawn_cameras
from studies.render_cost import __main__ as render_cost
from studies.scaling import __main__ as scaling
from studies.training_feed import __main__ as training_feed
from studies.world_variety import __main__ as world_variety


def said(capfd: pytest.CaptureFixture[str], call: Callable[[], object]) -> str:
    """The one line of a study that ends."""
    with pytest.raises(SystemExit) as ended:
        call()
    assert ended.value.code == WRONG_INPUT
    (line,) = capfd.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("study", "arguments", "fault"),
    [
        (drawn_cameras, ["measure", "EMPTY"], "EMPTY: has no dataset and no pictures; give a folder with .png"),
        (drawn_cameras, ["measure", "EMPTY/nowhere"], "nowhere: No such file or directory"),
        (drawn_cameras, ["cost", "--scenes", "0"], "--scenes: must be at least 1, got 0"),
        (drawn_cameras, ["redraw", "EMPTY", "--out", "EMPTY/out"], "EMPTY/manifest.json: is missing"),
        (world_variety, ["measure", "nosuchrecipe", "--out", "EMPTY"], "no shipped recipe is named 'nosuchrecipe'"),
        (world_variety, ["measure", "demo", "nosuchrecipe", "--out", "EMPTY"], "is named 'nosuchrecipe'"),
        (world_variety, ["detect", "EMPTY/nowhere"], "nowhere: there is no such dataset folder"),
        (world_variety, ["sheets", "nobody", "--out", "EMPTY"], "'nobody' is no subject"),
        (training_feed, ["--pairs", "0", "--out", "EMPTY"], "--pairs, --batch-pairs: must be at least 1"),
        (training_feed, ["--batch-pairs", "0", "--out", "EMPTY"], "--pairs, --batch-pairs: must be at least 1"),
    ],
)
def test_wrong_input_is_told_in_one_line(
    study: object, arguments: list[str], fault: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given = [argument.replace("EMPTY", str(tmp_path)) for argument in arguments]
    line = said(capfd, lambda: study.main(given))  # type: ignore[attr-defined]
    assert fault.replace("EMPTY", str(tmp_path)) in line
    assert list(tmp_path.iterdir()) == []


def test_damaged_results_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for name in ("results.json", "10m.json"):
        (tmp_path / name).write_text("{")
    monkeypatch.setattr(sys, "argv", ["scaling", "--out", str(tmp_path)])
    assert f"{tmp_path / 'results.json'}: is damaged" in said(capfd, scaling.main)
    assert f"{tmp_path / '10m.json'}: is damaged" in said(capfd, lambda: render_cost.main(tmp_path, [10.0], 1, 1, None))
