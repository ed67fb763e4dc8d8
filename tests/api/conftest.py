"""A small dataset for the tests of the Python interface."""

from __future__ import annotations

from pathlib import Path

import pytest

from droguekit.api.stereo_dataset import StereoDataset
from tests.support.recipe_builder import recipe_text
from tests.support.small_datasets import SINGLE_PAIRS, rendered

PAIRS_RECIPE = recipe_text(
    SINGLE_PAIRS,
    seed=5,
    frames={"count": 8, "scenes": 4, "empty_fraction": 0.4},
    outputs={"exr": True},
    split={"train": 0.5, "val": 0.25, "test": 0.25},
)


@pytest.fixture(scope="session")
def pairs_recipe_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recipe as a file."""
    file = tmp_path_factory.mktemp("recipe") / "pairs.toml"
    file.write_text(PAIRS_RECIPE)
    return file


@pytest.fixture(scope="session")
def pairs_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of the recipe; to be read only."""
    return rendered(PAIRS_RECIPE, tmp_path_factory.mktemp("pairs") / "dataset")


@pytest.fixture
def pairs(pairs_folder: Path) -> StereoDataset:
    """The dataset, opened."""
    return StereoDataset(pairs_folder)
