"""Recipes with changes, and pairs rendered in memory, against datasets that the command makes."""

from __future__ import annotations

import uuid
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import droguekit
from datasets_manifest.recipe.recipe import load_recipe
from droguekit.api.stereo_dataset import StereoDataset, StereoPair
from tests.support.recipe_builder import build_recipe
from tests.support.small_datasets import SINGLE_PAIRS


def labels(pair: StereoPair) -> dict[str, Any]:
    """The record without the hashes of files."""
    return pair.record.model_dump(mode="json", exclude={"file_sha256"})


def test_a_rendered_pair_is_that_of_the_dataset(pairs: StereoDataset, pairs_recipe_file: Path) -> None:
    threads = cv2.getNumThreads()
    recipe = droguekit.load_recipe(str(pairs_recipe_file))
    for stored in pairs[:4]:
        pair = droguekit.render_pair(recipe, stored.frame_index)
        assert np.array_equal(pair.left, stored.left)
        assert np.array_equal(pair.right, stored.right)
        assert labels(pair) == labels(stored)
        assert pair.drogue == stored.drogue
        assert np.array_equal(pair.part_ids["right"], stored.part_ids["right"])
        assert np.array_equal(pair.depth_m["right"], stored.depth_m["right"])
    assert cv2.getNumThreads() == threads


@pytest.mark.mitsuba
def test_a_pair_by_mitsuba_is_that_of_the_dataset(smoke_dataset: Path) -> None:
    stored = droguekit.open_dataset(smoke_dataset)[0]
    pair = droguekit.render_pair(droguekit.load_recipe("smoke"), 0)
    assert np.array_equal(pair.left, stored.left)
    assert labels(pair) == labels(stored)


def test_a_dataset_is_rendered_to_a_url_with_indices_of_any_whole_type() -> None:
    recipe, place = build_recipe(SINGLE_PAIRS, frames={"count": 3}), f"memory://{uuid.uuid4().hex}/mine"
    dataset = droguekit.render_dataset(recipe, place, frames=np.arange(1, 3), workers=0)
    assert [pair.frame_index for pair in dataset] == [1, 2] and dataset.path == place
    with pytest.raises(TypeError, match="integer"):
        droguekit.render_dataset(recipe, place, frames=[0.0], workers=0)  # type: ignore[list-item]
    with pytest.raises(TypeError, match="integer"):
        droguekit.render_dataset(recipe, place, workers=1.5)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="integer"):
        droguekit.render_pair(recipe, 1.5)  # type: ignore[arg-type]


def test_changes_replace_what_they_name_and_nothing_else() -> None:
    plain = load_recipe("smoke").recipe
    recipe = droguekit.load_recipe("smoke", seed=12, frames={"count": 3}, rig="mono")
    assert (recipe.seed, recipe.frames.count, recipe.sensor.color) == (12, 3, "mono")
    assert recipe.frames.scenes == plain.frames.scenes
    assert recipe.render == plain.render
    assert droguekit.load_recipe("smoke").model_dump(mode="json") == plain.model_dump(mode="json")


def test_a_change_of_the_law_replaces_the_section() -> None:
    recipe = droguekit.load_recipe("smoke", distance={"law": "stations", "stations_m": [3.0, 7.0]})
    assert recipe.distance.stations_m == (3.0, 7.0)
    assert recipe.distance.low_m is None


def test_a_change_of_an_unknown_key_names_it() -> None:
    with pytest.raises(ValueError, match=r"recipe smoke: .*frames\.cuont"):
        droguekit.load_recipe("smoke", frames={"cuont": 3})


def test_a_frame_outside_the_recipe_is_refused(pairs_recipe_file: Path) -> None:
    with pytest.raises(ValueError, match=r"frame: must be in \[0, 8\), got 8"):
        droguekit.render_pair(droguekit.load_recipe(str(pairs_recipe_file)), 8)


def test_a_device_that_the_engine_cannot_use_is_refused_before_anything_is_made(
    pairs_recipe_file: Path, tmp_path: Path
) -> None:
    recipe = droguekit.load_recipe(str(pairs_recipe_file))
    refused = (
        "^device cuda: engine analytic renders on the processor only; take device cpu or engine mitsuba or blender"
    )
    with pytest.raises(ValueError, match=refused):
        droguekit.render_pair(recipe, device="cuda")
    with pytest.raises(ValueError, match=refused):
        droguekit.render_dataset(recipe, tmp_path / "out", device="cuda")
    assert not (tmp_path / "out").exists()
