"""Recipes with changes, and what is rendered from them: a pair in memory, or a dataset on disk."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe import recipe as recipes
from datasets_manifest.recipe.recipe import Recipe, RecipeSource
from datasets_manifest.storage.storage import as_location
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from droguekit.api.stereo_dataset import StereoDataset, StereoPair
from droguekit.batch import render_dataset as datasets
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.frame_task import RenderedPair, eye_radiance, process_engine, render_frame
from droguekit.batch.progress import progress_report
from droguekit.numerical_threads import one_thread
from geometry.stereo import Eye
from render.device import Device

RECIPE_TEXT = "# This dataset was rendered from Python; manifest.json has the recipe with all its values.\n"


def load_recipe(name_or_path: str, **changes: Any) -> Recipe:
    """A recipe by the name of a shipped one, or from a TOML file, with changes.

    Args:
        name_or_path: name, or path of a `.toml` file.
        changes: replace keys of the file, in the form that TOML has; a mapping changes the keys that it names and
            leaves the others of its section, such as `seed=3, frames={"count": 8}, rig="mono"`.

    Raises:
        ValueError: there is no such recipe, or keys are wrong; names each key.
    """
    return recipes.load_recipe(name_or_path, changes=changes).recipe


def render_pair(recipe: Recipe, frame: int = 0, *, device: Device = "cpu") -> StereoPair:
    """Render one frame of a recipe: the same pixels and labels as in a dataset that `droguekit render` makes.

    The first call in a process loads the engine. An engine that this process already uses stays loaded.

    Args:
        recipe: from `load_recipe`.
        frame: its index, from 0 to the recipe's number of frames.
        device: to render on: `cpu`, or `cuda` for an NVIDIA GPU.

    Raises:
        ValueError: an index outside the recipe, or an engine or device that cannot be used.
        TypeError: an index that is no whole number.
    """
    frame = operator.index(frame)
    with one_thread():
        rendered = render_frame(recipe, frame, process_engine(recipe.render.engine, device))
    spec = rendered.record.frame
    return StereoPair(frame, spec.rig, spec.drogue or spec.sought or recipe.drogue, _RenderedSource(rendered))


def render_dataset(
    recipe: Recipe,
    out: str | Path,
    *,
    frames: Iterable[int] | None = None,
    workers: int | None = None,
    device: Device = "cpu",
) -> StereoDataset:
    """Render a recipe into a dataset; frames that exist there are kept.

    A script that uses worker processes must do its work below `if __name__ == "__main__":`.

    Args:
        recipe: from `load_recipe`.
        out: folder of the dataset, or a URL such as `s3://bucket/name`.
        frames: indices of the frames to render; all of the recipe when None.
        workers: number of worker processes; as many as cores and memory allow when None, 0 for this process itself.
        device: to render on: `cpu`, or `cuda` for an NVIDIA GPU.

    Raises:
        ValueError: frames outside the recipe, a folder of another recipe, or an engine or device that cannot be used.
        TypeError: an index of a frame, or a number of workers, that is no whole number.
        OSError: the folder cannot be written or the disk is full; finished frames stay.
        KeyboardInterrupt: stopped by the user; finished frames stay, and a second call goes on.
    """
    chosen = range(recipe.frames.count) if frames is None else [operator.index(index) for index in frames]
    if workers is not None and operator.index(workers) < 0:
        raise ValueError(f"workers: must not be negative, got {workers}")
    options = ExecutionOptions(workers, device=device)
    datasets.render_dataset(
        RecipeSource(recipe, RECIPE_TEXT), as_location(str(out)), chosen, options, progress_report()
    )
    return StereoDataset(out)


class _RenderedSource:
    """A pair in memory."""

    def __init__(self, rendered: RenderedPair) -> None:
        self._rendered = rendered

    def images(self) -> StereoImages:
        return self._rendered.images

    def record(self) -> PairRecord:
        return self._rendered.record

    def part_id(self, eye: Eye) -> NDArray[np.uint8]:
        return eye_radiance(self._rendered.radiance, eye).part_id

    def depth_m(self, eye: Eye) -> NDArray[np.float32]:
        return eye_radiance(self._rendered.radiance, eye).depth_m
