"""The page that compares two datasets in a real browser: contrast of its colours, and the words of its laws."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from droguekit.assurance.dataset_diff import DatasetDiff
from droguekit.assurance.law_comparison import compare_numbers, compare_words
from droguekit.visualization.diff_page import write_diff_page
from tests.support.recipe_builder import RIG_160_PX, between, recipe_text
from tests.support.small_datasets import rendered

OpenPage = Callable[..., Any]

WORDS = [f"drogue-{place:02d}-of-a-long-name" for place in range(30)]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Numbers that differ, and 30 words of which A and B share only the first."""
    folder = tmp_path_factory.mktemp("diff-page")
    recipe = recipe_text(
        {
            "name": "small",
            "rig": RIG_160_PX,
            "frames": {"count": 1},
            "distance": between(3.0, 4.0),
            "render": {"engine": "analytic"},
        }
    )
    data = rendered(recipe, folder / "data")
    numbers = np.linspace(1.0, 2.0, 40), np.linspace(2.0, 3.0, 40)
    words = [WORDS[0]] * 10 + WORDS[1:11], [WORDS[0]] * 10 + WORDS[11:]
    found = DatasetDiff(
        names=("a", "b"),
        sha256=("0" * 64, "1" * 64),
        pairs=(40, 40),
        same_frames=0,
        same_pixels=0,
        compared=(0, 0),
        recipe=(),
        manifest=(),
        labels=(
            compare_numbers("distance_m", "pairs", numbers, 1e-4),
            compare_words("drogue", "scenes", words, 1e-4),
        ),
        pixels=(),
    )
    out = folder / "diff.html"
    write_diff_page(found, (data, data), out, 0.005)
    return out


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width_px", [360, 1440])
def test_everything_can_be_read(open_page: OpenPage, page: Path, width_px: int, scheme: str) -> None:
    opened = open_page(page, width_px=width_px, scheme=scheme)
    opened.page.evaluate("() => document.querySelectorAll('details').forEach((e) => { e.open = true; })")
    assert [text for text in opened.contrasts() if not text.is_enough] == []
    assert opened.overflows() == [] and opened.faults == [] and opened.requests == []


def test_every_word_stands_on_the_page_with_both_shares(open_page: OpenPage, page: Path) -> None:
    opened = open_page(page)
    opened.page.evaluate("() => document.querySelectorAll('details').forEach((e) => { e.open = true; })")
    lines = [" ".join(text.split()) for text in opened.page.locator(".law li").all_inner_texts()]
    # The commonest first; 10 of 20 draws of A, 10 of 29 of B.
    assert lines[0] == f"{WORDS[0]} 50 % | 34.5 %"
    assert sorted(line.split()[0] for line in lines) == WORDS
    bars = opened.page.locator(".law li i").evaluate_all("(all) => all.map((bar) => bar.style.backgroundSize)")
    assert bars[:2] == ["50% 100%", "34.48% 100%"]


def test_bars_of_a_number_fill_its_picture(open_page: OpenPage, page: Path) -> None:
    """They stand over the ends of the range that are written below."""
    picture = open_page(page).page.locator(".law svg").first
    box = picture.bounding_box()
    bars = [bar.bounding_box() for bar in picture.locator("rect").all()]
    assert min(bar["x"] for bar in bars) == pytest.approx(box["x"], abs=1)
    last = max(bar["x"] + bar["width"] for bar in bars)
    # A gap of one unit of the drawing, some two pixels, follows every bar.
    assert box["x"] + box["width"] - 3 < last <= box["x"] + box["width"]
