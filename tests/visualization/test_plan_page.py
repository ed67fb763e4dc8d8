"""The plan as a page with plots."""

from __future__ import annotations

import base64
import re
from itertools import pairwise
from pathlib import Path
from typing import Unpack

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from droguekit.batch.recipe_plan import plan_recipe
from droguekit.cli.main import DONE, WRONG_INPUT, run
from droguekit.visualization.plan_page import DPI, PANEL_IN, _distances, _families, _sizes, label_logarithmic
from tests.support.recipe_builder import RecipeTable, between, build_recipe, recipe_text, stations
from tests.support.small_datasets import SWINGING

BASE: RecipeTable = {
    "name": "own",
    "description": "a < b & c",
    "frames": {"count": 40, "scenes": 4},
    "distance": between(2.0, 40.0, "log-uniform"),
}


def page_of(tmp_path: Path, **changes: Unpack[RecipeTable]) -> str:
    recipe = tmp_path / "own.toml"
    recipe.write_text(recipe_text(BASE, **changes), encoding="utf-8")
    out = tmp_path / "new" / "plan.html"
    assert run(["plan", str(recipe), "--no-probe", "--html", str(out)]) == DONE
    return out.read_text(encoding="utf-8")


def pictures(page: str) -> list[np.ndarray]:
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    images = [cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR) for data in found]
    assert all(image is not None and np.ptp(image) > 200 for image in images)
    return images


def test_the_page_needs_nothing_from_outside(tmp_path: Path) -> None:
    page = page_of(tmp_path, families=[{"name": "day"}, {"name": "dusk"}])
    assert "http:" not in page and "https:" not in page and "<script" not in page
    assert "a &lt; b &amp; c" in page
    assert len(pictures(page)) == 4


def test_the_page_repeats_what_the_command_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = page_of(tmp_path)
    said = capsys.readouterr().out.splitlines()
    assert said[-1].startswith("wrote ")
    shown = page[page.index("<pre>") + 5 : page.index("</pre>")].splitlines()
    assert [line.replace("&#39;", "'") for line in shown] == said[:-1]


def test_stations_have_bars_and_no_law_of_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(pictures(page_of(tmp_path, distance=stations(2.0, 5.0)))) == 3
    shown = capsys.readouterr().out
    assert "box sizes" not in shown
    assert "places of the box's middle" in shown


@pytest.mark.parametrize("count", [1, 12, 13, 40])
def test_labels_of_many_stations_stay_apart(count: int) -> None:
    recipe = build_recipe(BASE, distance=stations(*np.linspace(2.25, 120.5, count).round(2)), frames={"count": count})
    figure = Figure(figsize=PANEL_IN, dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    _distances(axes, recipe, plan_recipe(recipe))
    figure.draw_without_rendering()
    assert len(axes.patches) == count
    boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
    assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
    assert axes.get_xticklabels()[0].get_text() == "2.25"


FAMILIES: list[dict[str, object]] = [{"name": "clear"}, {"name": "hazy"}]


def test_pairs_are_counted_in_whole_numbers() -> None:
    recipe = build_recipe(BASE, distance=stations(2.0, 5.0), frames={"count": 2, "scenes": 2}, families=FAMILIES)
    planned = plan_recipe(recipe)
    for draw, axis in (
        (lambda axes: _distances(axes, recipe, planned), "yaxis"),
        (lambda axes: _sizes(axes, recipe, planned), "yaxis"),
        (lambda axes: _families(axes, planned), "xaxis"),
    ):
        axes = Figure(figsize=PANEL_IN, dpi=DPI).add_subplot()
        draw(axes)
        places = getattr(axes, axis).get_majorticklocs()
        assert len(places) >= 2 and np.array_equal(places, np.round(places))


def test_letters_can_be_read_on_a_phone(tmp_path: Path) -> None:
    (height_px, width_px) = pictures(page_of(tmp_path))[0].shape[:2]
    assert height_px < width_px
    # 10 pt as drawn; a page 360 px wide leaves a picture some 330.
    assert 10 / 72 * DPI * 330 / width_px >= 9


def test_the_law_is_printed_with_its_chi_square(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "detector-small", "--no-probe"]) == DONE
    shown = capsys.readouterr().out
    assert "box sizes, side of the square with the box's area, law log-uniform:" in shown
    assert len(re.findall(r"chi-square [\d.]+ with (?:9|47) degrees of freedom", shown)) == 2


def test_without_drogues_there_are_no_boxes(tmp_path: Path) -> None:
    assert pictures(page_of(tmp_path, frames={"empty_fraction": 1.0})) == []


def test_pairs_that_cannot_be_made_are_listed_with_their_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = tmp_path / "swinging.toml"
    recipe.write_text(recipe_text(SWINGING), encoding="utf-8")
    assert run(["plan", str(recipe), "--no-probe", "--html", str(tmp_path / "plan.html")]) == DONE
    shown = capsys.readouterr().out
    dropped = re.findall(r"^  frame (\d+): sequence 0: leaves the visible volume at", shown, re.MULTILINE)
    assert f"cannot be made, and will be missing: {len(dropped)} pairs, {5 * len(dropped):.1f} %" in shown
    assert len(pictures((tmp_path / "plan.html").read_text(encoding="utf-8"))) == 3


def test_a_page_that_cannot_be_written_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert run(["plan", "smoke", "--no-probe", "--html", str(tmp_path / "file" / "plan.html")]) == WRONG_INPUT
    assert str(tmp_path / "file") in capsys.readouterr().err


@pytest.mark.parametrize("ratio", [1.03, 1.2, 2.0, 2.99, 3.1, 8.0, 12.0, 13.0, 100.0, 400.0, 4000.0, 1e7])
@pytest.mark.parametrize("low", [0.0011, 0.7, 5.0, 16.8])
def test_logarithmic_axes_of_any_range_have_several_labels(low: float, ratio: float) -> None:
    axes = Figure().add_subplot()
    axes.set(xscale="log", xlim=(low, low * ratio))
    label_logarithmic(axes.xaxis, *axes.get_xlim())
    ticks = axes.xaxis.get_major_locator()()
    shown = [axes.xaxis.get_major_formatter()(tick) for tick in ticks if low <= tick <= low * ratio]
    assert 3 <= len(shown) <= 10
    # No two labels of an axis read alike.
    assert len(set(shown)) == len(shown)
