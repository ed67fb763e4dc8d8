"""Datasets with everything that exports must cope with, drawn by the z-buffer of the folder above."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.frame import FrameSpec
from drogue_models.presets import PRESETS
from geometry.se3 import RigidTransform
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import Pair, write_drawn_dataset
from tests.support.recipe_builder import RIG_160_PX, Section, build_recipe, stations


def small_recipe_of(preset: str, rig: Section | None = None) -> Recipe:
    """A recipe of small frames by a rig of this preset, with more keys of the rig."""
    return build_recipe(
        name="mixed",
        seed=918273645,
        rig={**RIG_160_PX, "preset": preset, **(rig or {})},
        frames={"count": 9, "scenes": 9, "empty_fraction": 0.25},
        distance=stations(1.7, 2.5, 4.0),
        split={"train": 0.4, "val": 0.3, "test": 0.3},
    )


def mixed_recipe() -> Recipe:
    """Drogues of eight, five and seven markers, the last one without a hub."""
    recipe = small_recipe_of("rgb-ideal")
    drogues = [
        PRESETS["red-8"],
        PRESETS["white-5"],
        PRESETS["red-7"].model_copy(update={"hub": None, "name": "bare-7"}),
    ]
    table = recipe.model_dump()
    table["target"]["variants"] = [{"drogue": drogue.model_dump()} for drogue in drogues]
    return Recipe.model_validate(table)


def moved(frame: FrameSpec, right_m: float) -> FrameSpec:
    """The frame with its drogue, and what hangs on it, further to the right."""
    pose = frame.left_from_drogue
    assert pose is not None
    away = RigidTransform(pose.rotation, pose.translation_m + np.array([right_m, 0.0, 0.0]))
    return frame.model_copy(update={"left_from_drogue": away})


@pytest.fixture(scope="session")
def mixed_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drogues, empty frames, a drogue that both images cut off, and one that none shows; to be read only."""
    recipe = mixed_recipe()
    frames = [sample_frame(recipe, index) for index in range(recipe.frames.count)]
    with_drogue = [index for index, frame in enumerate(frames) if frame.drogue is not None]
    assert {frames[index].drogue.marker_count for index in with_drogue[2:]} == {5, 7, 8}
    assert len(with_drogue) < len(frames)
    cut, outside = with_drogue[:2]
    z_m = [frame.left_from_drogue.translation_m[2] if frame.drogue is not None else 0.0 for frame in frames]
    # Half the width of the image away from the axis, and all of it.
    x_m = frames[cut].left_from_drogue.translation_m[0]
    frames[cut] = moved(frames[cut], 80 / 266 * z_m[cut] - x_m)
    frames[outside] = moved(frames[outside], 320 / 266 * z_m[outside])
    return write_drawn_dataset(tmp_path_factory.mktemp("mixed") / "dataset", recipe, map(Pair, frames))


@pytest.fixture(scope="session")
def dataset_by_preset(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A dataset of three pairs by a rig; to be read only."""

    def make(preset: str, rig: Section | None = None) -> Path:
        recipe = small_recipe_of(preset, rig)
        drawn = [Pair(sample_frame(recipe, index)) for index in range(3)]
        return write_drawn_dataset(tmp_path_factory.mktemp(preset) / "dataset", recipe, drawn)

    return make
