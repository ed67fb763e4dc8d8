"""Small datasets of the shipped recipes, by the analytic engine, with estimates whose errors are known."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe, RecipeSource, load_recipe
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, write_estimates
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from geometry.se3 import RigidTransform
from tests.support.shared_folder import shared_folder

# Of both sequences of the recipe, near and far, with gaps between.
DOCKING_FRAMES = (0, 1, 2, 5, 200, 449, 450, 452)

WriteEstimates = Callable[..., Path]


# A quarter of the pixels along each side, at the same field of view.
_QUARTER_SIZE = {"width_px": 320, "height_px": 240, "focal_px": 533.0}


def _small(recipe_name: str, preset: str) -> RecipeSource:
    """A shipped recipe with the analytic engine and small images by its rig's preset."""
    changes = {"rig": _QUARTER_SIZE | {"preset": preset}, "render": {"engine": "analytic"}}
    return load_recipe(recipe_name, changes=changes)


def _render(folder: Path, source: RecipeSource, frames: Iterable[int]) -> Path:
    told = io.StringIO()
    summary = render_dataset(source, folder, list(frames), 0, PlainProgress(told))
    assert summary.drops == (), told.getvalue()
    return folder


@pytest.fixture(scope="session")
def docking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight pairs of `docking-10m`; to be read only."""
    return shared_folder(
        tmp_path_factory, "docking", lambda out: _render(out, _small("docking-10m", "rgb-ideal"), DOCKING_FRAMES)
    )


@pytest.fixture(scope="session")
def single_pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pairs of the docking scenes that follow no sequence, 0 and 2 without a drogue; to be read only."""
    source = _small("docking-10m", "rgb-ideal")
    frames = source.recipe.frames.model_copy(update={"count": 8, "empty_fraction": 0.5, "stream": ""})
    recipe = Recipe.model_validate(dict(source.recipe) | {"sequence": None, "frames": frames})
    single = RecipeSource(recipe, source.text)
    folder = shared_folder(tmp_path_factory, "single", lambda out: _render(out, single, range(4)))
    data = Dataset(folder)
    assert [data.record(k).left_from_drogue is None for k in range(4)] == [True, False, True, False]
    return folder


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three pairs of `semi-physical-7`, at its first three stations; to be read only."""
    return shared_folder(
        tmp_path_factory, "bench", lambda out: _render(out, _small("semi-physical-7", "paper-colour"), range(3))
    )


@pytest.fixture(scope="session")
def estimates_of(tmp_path_factory: pytest.TempPathFactory) -> WriteEstimates:
    """`estimates_of(dataset, {method: (x, y, z) error in metres}, without={method: frames})`: a file of estimates."""

    def written(
        dataset: Path,
        errors_m: Mapping[str, Sequence[float]],
        without: Mapping[str, Sequence[int]] | None = None,
    ) -> Path:
        data, estimates = Dataset(dataset), list[Estimate]()
        for index in data.frame_indices:
            # Where there is no drogue, each method sees one all the same.
            pose = data.record(index).left_from_drogue or RigidTransform(np.eye(3), np.array([0.0, 0.0, 5.0]))
            for method, error_m in errors_m.items():
                if index in (without or {}).get(method, ()):
                    estimates.append(NoFix(frame_index=index, method=method, reason="hidden by the test"))
                    continue
                moved = RigidTransform(pose.rotation, pose.translation_m + np.asarray(error_m))
                stages = {"detect": 0.010, "pose": 0.002}
                estimates.append(PoseEstimate(frame_index=index, method=method, left_from_drogue=moved, stage_s=stages))
        path = tmp_path_factory.mktemp("estimates") / "estimates.jsonl"
        write_estimates(path, estimates)
        return path

    return written
