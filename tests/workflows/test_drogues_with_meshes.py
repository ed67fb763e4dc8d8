"""Truth of a drogue with a user's mesh, and datasets of it away from the mesh's folder."""

from __future__ import annotations

import io
import json
import shutil
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.layout import MESHES_FOLDER, RECIPE_FILE
from datasets_manifest.storage.reader import Dataset
from drogue_models.drogue_families import mesh_files
from drogue_models.drogue_families.body_symmetry import body_symmetry_order
from drogue_models.parts import Part
from droguekit.batch.merge_shards import merge_shards
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import describe_dataset
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.part_pixels import drogue_hull_m
from labelgen.validation.dataset_checks import validate_dataset
from labelgen.validation.label_checks import box_faults, check_against_passes, projection_faults
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import Pair, write_drawn_dataset
from tests.support.recipe_builder import RIG_160_PX, RIG_320_PX, build_recipe, recipe_text, stations


def funnel_recipe(folder: Path, rig: dict[str, object], count: int) -> Recipe:
    """A recipe of the shipped example, copied into a folder."""
    with as_file(files("drogue_models") / "examples") as examples:
        shutil.copytree(examples, folder)
    return build_recipe(
        name="meshes", seed=4, drogue=folder / "funnel.toml", rig=rig, frames={"count": count, "scenes": 1},
        distance=stations(1.6, 2.2), pose={"pitch_deg": [-15, 15], "yaw_deg": [-15, 15]},
        environment={"clouds": {"scene_fraction": 0.0}},
    )  # fmt: skip


def test_labels_of_the_shipped_example_agree_with_the_pixels(tmp_path: Path) -> None:
    recipe = funnel_recipe(tmp_path / "mine", RIG_320_PX, 3)
    for index in range(3):
        pair = Pair(sample_frame(recipe, index))
        record = pair.record
        assert check_against_passes(record, pair.radiance) + projection_faults(record) + box_faults(record) == []
        assert np.count_nonzero(pair.radiance.left.part_id == Part.HUB) > 50
    # The funnel is turned about the axis in 48 steps.
    assert body_symmetry_order(recipe.drogue) == 48


@pytest.fixture
def lonely_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset as another process reads it, elsewhere and without the file of the drogue's mesh."""
    recipe = funnel_recipe(tmp_path / "mine", RIG_160_PX, 2)
    folder = tmp_path / "dataset"
    monkeypatch.chdir(tmp_path / "mine")
    write_drawn_dataset(folder, recipe, [Pair(sample_frame(recipe, index)) for index in range(2)])
    monkeypatch.chdir("/")
    describe_dataset(recipe, folder, ())
    (folder / RECIPE_FILE).write_text(recipe_text(drogue="funnel.toml"))
    shutil.rmtree(tmp_path / "mine")
    mesh_files._stored_meshes.clear()
    drogue_hull_m.cache_clear()
    return folder


def test_a_dataset_holds_the_meshes_of_its_drogues(lonely_dataset: Path, tmp_path: Path) -> None:
    report = validate_dataset(lonely_dataset)
    assert report.faults == [] and {check.name: check.count for check in report.checks}["meshes"] == 1
    for name in ("bop", "coco", "kitti"):
        write_export(name, lonely_dataset, tmp_path / name, ExportLog())
    assert json.loads((tmp_path / "bop/models/models_info.json").read_text())["1"]["size_x"] == pytest.approx(
        600, abs=1
    )
    merge_shards(tmp_path / "merged", [lonely_dataset], PlainProgress(io.StringIO()))
    assert validate_dataset(tmp_path / "merged").faults == []


def test_changed_and_missing_copies_of_a_mesh_are_faults(lonely_dataset: Path) -> None:
    (copy,) = (lonely_dataset / MESHES_FOLDER).iterdir()
    whole = copy.read_bytes()
    copy.write_bytes(whole[:-1])
    assert any("was changed: its hash differs" in fault for fault in validate_dataset(lonely_dataset).faults)
    copy.unlink()
    assert any(f"{copy.name}: is missing; `render`" in fault for fault in validate_dataset(lonely_dataset).faults)


def test_a_copy_that_is_gone_hides_no_other(lonely_dataset: Path, tmp_path: Path) -> None:
    other = tmp_path / "copied"
    shutil.copytree(lonely_dataset, other)
    drogue = Dataset(lonely_dataset).manifest.recipe.drogue
    assert Dataset(other).manifest.recipe.drogue == drogue
    shutil.rmtree(other)
    assert drogue_hull_m(drogue).size
