"""The stored measurements of a distance, and the table."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from droguekit.batch.progress import PlainProgress, ProgressReport
from studies.render_cost.__main__ import CYCLES, MITSUBA, OWN, CostOptions, stored_station, table_lines
from studies.render_cost.noise_search import MeasuredView, frame_at, recipe_at


def station() -> dict[str, Any]:
    row = {"noise": 0.05, "samples": 16, "cpu_s": 2.0, "is_least": False, "is_carried_on": False}
    others = {MITSUBA: row | {"cpu_s": 50.0, "is_carried_on": True}, CYCLES: row | {"cpu_s": 80.0, "is_least": True}}
    return {"distance_m": 10.0, "renderers": {OWN: row, **others}}


def test_figures_are_used_again_only_for_their_options_code_and_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told, measured = io.StringIO(), list[CostOptions]()

    def measure(distance_m: float, options: CostOptions, report: ProgressReport) -> dict[str, Any]:
        measured.append(options)
        return station()

    monkeypatch.setattr("studies.render_cost.__main__.compare_at", measure)
    report, options = PlainProgress(told), CostOptions(3, 2, 4)
    for _ in range(2):
        assert stored_station(tmp_path, 10.0, options, report) == station()
    assert measured == [options] and told.getvalue() == ""
    stored_station(tmp_path, 20.0, options, report)
    for changes in ({"seed": 4}, {"repeat": 3}, {"full_samples": None}):
        stored_station(tmp_path, 10.0, replace(options, **changes), report)  # type: ignore[arg-type]
    assert len(measured) == 5
    assert told.getvalue().count("10m.json: 1 of 1 results are of other options, code or machine") == 3
    monkeypatch.setattr("studies.stored_figures.RENDER_VERSION", "0")
    stored_station(tmp_path, 20.0, options, report)
    assert len(measured) == 6


def test_lower_bounds_and_extrapolations_are_marked() -> None:
    assert table_lines([station()])[-1] == (
        "| 10 m | 5.0% | 2.00 s | 50 s at 16* | at least 80 s at 16 | 25 | at least 40 |"
    )


def test_the_crop_holds_the_drogue() -> None:
    drogue = np.zeros((960, 1280), dtype=bool)
    drogue[400:450, 5:90] = True
    view = MeasuredView(frame_at(10.0, 1), recipe_at(10.0, 1).render, drogue, drogue)
    left, top, width, height = view.crop
    assert left == 0 and top < 400 and top + height > 450 and width > 90
    assert all(np.count_nonzero(mask) == 50 * 85 for mask in view.masks)


@pytest.mark.parametrize("distance_m", [2.0, 40.0])
def test_frames_rest_at_their_distance(distance_m: float) -> None:
    frame = frame_at(distance_m, 1)
    assert frame.left_from_drogue is not None
    assert frame.left_from_drogue.translation_m[2] == pytest.approx(distance_m, rel=1e-9)
    assert frame_at(distance_m, 1, 1).environment != frame.environment
