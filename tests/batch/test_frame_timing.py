"""Measuring what frames cost."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import pytest

import droguekit.batch.frame_cost as measure
from datasets_manifest.recipe.recipe import Recipe, parse_recipe
from droguekit.batch.frame_cost import frames_per_second, warm_up_frames
from tests.support.batch_datasets import ANALYTIC_RECIPE


def of_frames(recipe_text: str, count: int) -> Recipe:
    recipe = parse_recipe(recipe_text)
    return recipe.model_copy(update={"frames": recipe.frames.model_copy(update={"count": count})})


def test_the_rate_is_of_the_frames_after_the_first_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    # By a clock that goes on by half a second with every frame, and had stood before them for an hour.
    told_s = itertools.chain([0.0], itertools.count(3600.0, 0.5))
    monkeypatch.setattr(measure, "time", SimpleNamespace(monotonic=lambda: next(told_s)))
    assert frames_per_second(of_frames(ANALYTIC_RECIPE, warm_up_frames(2) + 3), workers=2) == 2.0


def test_a_recipe_of_first_frames_alone_has_no_rate() -> None:
    with pytest.raises(ValueError, match="8 are too few for 2 workers; 8 do not count"):
        frames_per_second(of_frames(ANALYTIC_RECIPE, warm_up_frames(2)), workers=2)


def test_an_engine_that_is_missing_ends_the_measurement() -> None:
    recipe = of_frames(
        ANALYTIC_RECIPE.replace('engine = "analytic"', 'engine = "no-such-engine"'), warm_up_frames(1) + 1
    )
    with pytest.raises(ValueError, match="no-such-engine"):
        frames_per_second(recipe, workers=1)
