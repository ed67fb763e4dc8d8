"""Cells and tiers C and D through their whole path, with small numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from studies.acceptance.centroid_level.centroid_tiers import measure_tier_c, measure_tier_d
from studies.acceptance.centroid_level.drawn_frames import Corruption
from studies.acceptance.centroid_level.monte_carlo import CELLS_FILE, Cell, run_cell, run_cells

CELL = Cell("joint-hub", 8, (5.0, 5.0), 0.1, 200, 1)


class Listener:
    def __init__(self) -> None:
        self.said: list[str] = []
        self.total = self.done = 0

    def begin(self, what: str, total: int) -> None:
        self.total, self.done = total, 0

    def advance(self) -> None:
        self.done += 1

    def say(self, text: str) -> None:
        self.said.append(text)

    def end(self) -> None:
        pass


def test_a_cell_reaches_the_bound_and_tells_the_truth_about_its_errors() -> None:
    result = run_cell(replace(CELL, draws=1000))
    assert result.fixes == result.n == 1000
    # Root mean squares of 1000 normal numbers are within 2.2 % of theirs; four of these.
    assert result.nrms == pytest.approx([1.0] * 5, rel=0.09)
    # 5000 degrees of freedom: 2 %; four of these.
    assert result.nees == pytest.approx(1.0, abs=0.08)
    assert result.flips == 0


def test_errors_go_with_the_noise() -> None:
    # One draw of noise, scaled: the errors of a nearly linear problem scale along.
    fine, coarse = run_cell(replace(CELL, sigma_px=1e-4)), run_cell(replace(CELL, sigma_px=1e-3))
    assert fine.nrms[2] == pytest.approx(coarse.nrms[2], rel=0.25)
    assert fine.z_rms_m < coarse.z_rms_m / 5


def test_bad_markers_hurt_the_plain_method_and_not_the_robust_one() -> None:
    bad = replace(CELL, method="joint", draws=40, corruption=Corruption(1))
    plain, robust = run_cell(bad), run_cell(replace(bad, method="joint-robust"))
    # The specification's prototype: a tenth; a factor of two is left to chance.
    assert robust.position_mean_m < plain.position_mean_m / 5


def test_a_stopped_run_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    cells = [CELL, replace(CELL, sigma_px=0.2)]
    whole = run_cells(cells, tmp_path / "whole", Listener())
    run_cells(cells[:1], tmp_path / "parts", Listener())
    listener = Listener()
    assert run_cells(cells, tmp_path / "parts", listener) == whole
    assert (listener.total, listener.done) == (1, 1)
    assert listener.said == ["1 of 2 cells are finished already"]


def test_cells_of_other_code_are_made_again(tmp_path: Path) -> None:
    run_cells([CELL], tmp_path, Listener())
    path = tmp_path / CELLS_FILE
    table = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**table, "code": "another"}), encoding="utf-8")
    listener = Listener()
    run_cells([CELL], tmp_path, listener)
    assert listener.done == 1
    assert "other code" in listener.said[0]


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"code": "x", "cells": 2}', '{"code": "x", "cells": [1]}', "not json"]
)
def test_a_file_of_something_else_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / CELLS_FILE).write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"cells\.json: does not hold cells"):
        run_cells([CELL], tmp_path, Listener())


@pytest.mark.slow
def test_tier_c_runs_through(tmp_path: Path) -> None:
    rows = measure_tier_c(tmp_path, 1, 10, Listener())
    assert [row.bar for row in rows] == ["5", "5", "6", "6", "7", "7", "9", "9", "10", "10", "10"]
    assert all(row.measured is not None and row.n > 0 for row in rows)
    # Over 1000 draws a pooled ratio is within 2.2 % of one; three of these.
    assert rows[0].measured == pytest.approx(1.0, abs=0.07)


def test_tier_d_runs_through(tmp_path: Path) -> None:
    rows = measure_tier_d(tmp_path, 1, 4, Listener())
    assert [row.bar for row in rows] == ["11", "11", "11", "12", "12", "12"]
    assert all(row.measured is not None and row.n > 0 for row in rows)


def test_a_method_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no-such"):
        run_cell(replace(CELL, method="no-such", draws=2))
