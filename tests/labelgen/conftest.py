"""Six small pairs, with all that was made of them, and the dataset of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from datasets_manifest.recipe.recipe import Recipe
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import Pair, write_drawn_dataset
from tests.support.recipe_builder import RIG_160_PX, build_recipe, stations


@pytest.fixture(scope="session")
def small_recipe() -> Recipe:
    return build_recipe(
        name="small",
        seed=3,
        rig=RIG_160_PX,
        frames={"count": 6, "scenes": 3, "empty_fraction": 0.3},
        distance=stations(1.7, 2.5, 4.0),
        split={"train": 0.34, "val": 0.33, "test": 0.33},
    )


@pytest.fixture(scope="session")
def pairs(small_recipe: Recipe) -> list[Pair]:
    """All frames of the recipe: some near, some far, at least one without a drogue."""
    drawn = [Pair(sample_frame(small_recipe, index)) for index in range(small_recipe.frames.count)]
    assert any(pair.frame.drogue is None for pair in drawn)
    return drawn


@pytest.fixture(scope="session")
def full_pairs(pairs: list[Pair]) -> list[Pair]:
    """Those with a drogue."""
    return [pair for pair in pairs if pair.frame.drogue is not None]


@pytest.fixture
def small_dataset(tmp_path: Path, small_recipe: Recipe, pairs: list[Pair]) -> Path:
    """A dataset that a test may damage."""
    return write_drawn_dataset(tmp_path / "dataset", small_recipe, pairs)
