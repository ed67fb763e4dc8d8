"""The page on pose accuracy in a real browser: phone and desktop, light and dark, folded tables."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, write_estimates
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from droguekit.cli.main import DONE, run
from droguekit.scoring.report.html_page import MOST_OPEN_ROWS
from droguekit.workflows.rendering import open_recipe
from geometry.se3 import RigidTransform

OpenPage = Callable[..., Any]

PAIRS = 2
# The last name is one long word, which no line of a phone has room for.
METHODS = [*(f"method-{k}" for k in range(MOST_OPEN_ROWS)), "w" * 80]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some pairs, with poses of many methods that err a little."""
    folder, rng = tmp_path_factory.mktemp("pose-report"), np.random.default_rng(5)
    source = open_recipe("semi-physical-7", None, "analytic")
    render_dataset(source, folder / "data", list(range(PAIRS)), 0, PlainProgress(io.StringIO()))
    data, estimates = Dataset(folder / "data"), []
    for index in data.frame_indices:
        pose = data.record(index).left_from_drogue
        assert pose is not None
        for name in METHODS:
            moved = RigidTransform(pose.rotation, pose.translation_m + rng.normal(0, 1e-3, 3))
            estimates.append(PoseEstimate(frame_index=index, method=name, left_from_drogue=moved))
    write_estimates(folder / "estimates.jsonl", estimates)
    given, page = ["--estimates", str(folder / "estimates.jsonl")], folder / "report.html"
    out = ["--json", str(folder / "benchmark.json"), "--html", str(page)]
    assert run(["benchmark", str(folder / "data"), *given, *out]) == DONE
    return page


@pytest.mark.parametrize(("width_px", "scheme"), [(320, "light"), (360, "dark"), (1280, "light"), (1280, "dark")])
def test_nothing_is_wrong_with_tables_folded_or_open(
    open_page: OpenPage, report: Path, width_px: int, scheme: str
) -> None:
    opened = open_page(report, width_px=width_px, scheme=scheme)
    for is_open in (False, True):
        opened.page.evaluate(
            "(open) => document.querySelectorAll('details').forEach((e) => { e.open = open; })", is_open
        )
        assert opened.overflows() == []
        assert [text for text in opened.contrasts() if not text.is_enough] == []
    assert opened.faults == []
    assert opened.requests == []


def test_a_click_on_its_title_opens_a_long_table(open_page: OpenPage, report: Path) -> None:
    page = open_page(report).page
    table = page.locator("#table-z")
    assert not table.is_visible()
    page.get_by_text("Z, depth [mm]").last.click()
    assert table.is_visible()
    assert table.locator("tbody tr").count() == len(METHODS)


def test_folded_tables_are_not_printed_and_open_ones_are(open_page: OpenPage, report: Path, tmp_path: Path) -> None:
    opened = open_page(report)
    folded = opened.print_pdf(tmp_path / "folded.pdf")
    opened.page.evaluate("() => document.querySelectorAll('details').forEach((e) => { e.open = true; })")
    assert len(opened.print_pdf(tmp_path / "open.pdf")) > len(folded)
