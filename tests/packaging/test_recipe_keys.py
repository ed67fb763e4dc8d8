"""The page about the keys of recipes: made of the code at hand, and complete."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from datasets_manifest.recipe.recipe import load_recipe

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "scripts" / "recipe_keys.py"))


def test_the_page_is_that_of_this_code(script: dict[str, Any]) -> None:
    # After a change of keys or of their docstrings: .venv/bin/python scripts/recipe_keys.py
    assert script["page"]() == script["PAGE"].read_text(encoding="utf-8")


def test_every_key_is_explained(script: dict[str, Any]) -> None:
    rows = re.findall(r"^\| (`\w+`) \|.*\| (.*) \|$", script["page"](), re.MULTILINE)
    assert len(rows) > 200
    assert [key for key, text in rows if not text.strip() or re.search("see `[A-Z]", text)] == []


@pytest.mark.parametrize(
    ("change", "limits"),
    [
        ({"pose": {"pitch_deg": [0, 61]}}, "`pitch_deg` | [-10, 10] | range within -60 to 60 "),
        ({"environment": {"turbidity": 11}}, "`turbidity` | [2.2, 4] | range within 1.9 to 10 "),
        ({"camera": {"contrast": 1.5}}, "`contrast` | [-0.1, 0.4] | range within -0.5 to 1 "),
        ({"frames": {"count": 10_000_001}}, "`count` | *needed* | whole number, from 1 to 10_000_000 "),
        ({"exposure": {"f_number": 65}}, "`f_number` | 2.8 | number, from 0.5 to 64 "),
    ],
)
def test_values_beyond_the_limits_are_refused(change: dict[str, Any], limits: str, script: dict[str, Any]) -> None:
    assert limits in script["page"]()
    with pytest.raises(ValueError, match=next(iter(next(iter(change.values()))))):
        load_recipe("smoke", changes=change)
