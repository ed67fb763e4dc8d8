"""Figures: well formed, with gaps where there is no pose, and nothing hidden by a scale."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from studies.paper.docking_experiment import DockingRun
from studies.paper.paper_figures import (
    PITCH,
    CorpusBoxes,
    X,
    error_series,
    length_series,
    place_panel,
    shape_panel,
    size_panel,
    truth_series,
)
from studies.paper.published_results import CONTENDERS, present, style_of

METHODS = present(["joint-hub", "paper"])
COUNT = 40


def make_run(errors: np.ndarray, others: np.ndarray | None = None) -> DockingRun:
    truth = np.linspace([0.1, 0.0, 10.0], [0.0, 0.1, 1.7], COUNT)
    other = errors if others is None else others
    return DockingRun(0, np.arange(COUNT), truth, {"joint-hub": errors, "paper": other})


def title_of(svg: str) -> str:
    return " ".join(text.text or "" for text in ElementTree.fromstring(svg).iter("text"))


def lines_of(svg: str, method: str) -> list[str]:
    """Paths of the data of a method, not those of marks."""
    color = style_of(method).color
    return [
        path.attrib["d"]
        for path in ElementTree.fromstring(svg).iter("path")
        if f"stroke: {color}" in path.attrib.get("style", "") and "fill: none" in path.attrib.get("style", "")
    ]


def marks_of(svg: str, method: str) -> list[ElementTree.Element]:
    """Marks and dots of the data of a method."""
    color = style_of(method).color
    uses = list(ElementTree.fromstring(svg).iter("use"))
    return [use for use in uses if f"fill: {color}" in use.attrib.get("style", "")]


def test_a_line_breaks_where_there_is_no_pose() -> None:
    errors = np.full((COUNT, 5), 1e-3)
    errors[10:15] = np.nan
    whole, broken = np.full((COUNT, 5), 2e-3), errors
    svg = error_series("f", make_run(whole, broken), METHODS, X)
    assert [path.count("M") for path in lines_of(svg, "joint-hub")] == [1]
    assert [path.count("M") for path in lines_of(svg, "paper")] == [2]


def test_single_poses_stand_as_dots() -> None:
    errors = np.full((COUNT, 5), np.nan)
    errors[7] = 1e-3
    svg = error_series("f", make_run(errors), METHODS[:1], X)
    # The dot, and the method's mark on it.
    assert len(marks_of(svg, "joint-hub")) == 2


def test_marks_tell_lines_apart_that_lie_on_each_other() -> None:
    svg = error_series("f", make_run(np.full((COUNT, 5), 1e-3)), METHODS, X)
    ours, paper = (marks_of(svg, contender.method) for contender in METHODS)
    assert len(ours) >= 8 and len(paper) >= 8
    places = [{use.attrib["x"] for use in marks} for marks in (ours, paper)]
    assert places[0].isdisjoint(places[1])
    assert {use.attrib["href"] for use in ours}.isdisjoint(use.attrib["href"] for use in paper)


def test_poses_outside_the_panel_of_the_truth_are_counted() -> None:
    errors = np.full((COUNT, 5), 1e-3)
    errors[[3, 9], 0] = 7.0
    svg = truth_series("f", make_run(errors, np.full((COUNT, 5), 1e-3)), METHODS, X)
    assert "[m], 2 outside" in title_of(svg)
    assert "outside" not in title_of(truth_series("f", make_run(np.full((COUNT, 5), 1e-3)), METHODS, X))


def test_far_larger_errors_are_counted_instead_of_flattening_the_rest() -> None:
    # One in two hundred: below the percentile that is shown.
    run = make_run(np.full((COUNT, 5), 1e-3))
    many = DockingRun(
        0, np.arange(200), np.zeros((200, 3)), {"joint-hub": np.resize(run.errors["paper"], (200, 5)).copy()}
    )
    many.errors["joint-hub"][17, 0] = 1.0
    assert "1 larger not shown" in title_of(error_series("f", many, METHODS[:1], X))
    assert "not shown" not in title_of(error_series("f", run, METHODS, X))


def test_the_published_limit_is_drawn_only_where_it_fits() -> None:
    for size, drawn in ((0.8, 2), (1e-3, 0)):
        svg = error_series("f", make_run(np.full((COUNT, 5), size)), METHODS[:1], PITCH)
        dotted = [
            path for path in ElementTree.fromstring(svg).iter("path") if "dasharray" in path.attrib.get("style", "")
        ]
        assert len(dotted) == drawn


@pytest.mark.parametrize("errors", [np.full((COUNT, 5), np.nan), np.zeros((COUNT, 5))], ids=["no pose", "no error"])
def test_empty_and_perfect_series_can_be_drawn(errors: np.ndarray) -> None:
    run = make_run(errors)
    for svg in (
        error_series("f", run, METHODS, X),
        truth_series("f", run, METHODS, X),
        length_series("f", run, METHODS),
    ):
        ElementTree.fromstring(svg)
        assert "nan" not in svg and "inf" not in svg


def test_ids_of_all_figures_differ() -> None:
    run = make_run(np.full((COUNT, 5), 1e-3))
    svgs = [error_series("figure-16", run, METHODS, X), error_series("figure-18", run, METHODS, X)]
    ids = [found for svg in svgs for found in re.findall(r'\bid="([^"]+)"', svg)]
    assert len(ids) == len(set(ids))


def test_contenders_look_different() -> None:
    assert len({style_of(contender.method) for contender in CONTENDERS}) == len(CONTENDERS)


def test_every_drogue_of_a_corpus_is_in_its_figures(docking: Path) -> None:
    rng = np.random.default_rng(5)
    low = rng.uniform(0, 900, (300, 2))
    boxes = np.concatenate([low, rng.uniform(5, 60, (300, 2))], axis=1)
    corpus = CorpusBoxes(Dataset(docking).manifest, 400, 3, (1280, 960), boxes, np.linspace(2, 40, 300))
    middles = boxes[:, :2] + boxes[:, 2:] / 2
    # 24 cells across, so 18 down; the pixel-centre frame begins half a pixel before 0.
    cells = {(int((u + 0.5) // (1280 / 24)), int((v + 0.5) // (960 / 18))) for u, v in middles}
    for svg, least in ((place_panel(corpus), len(cells)), (shape_panel(corpus), 1), (size_panel(corpus), 1)):
        root = ElementTree.fromstring(svg)
        filled = [path for path in root.iter("path") if "#1f78c8" in path.attrib.get("style", "")]
        assert len(filled) >= least
        assert "px]" in title_of(svg)
    drawn = [
        p for p in ElementTree.fromstring(place_panel(corpus)).iter("path") if "#1f78c8" in p.attrib.get("style", "")
    ]
    assert len(drawn) == len(cells)
