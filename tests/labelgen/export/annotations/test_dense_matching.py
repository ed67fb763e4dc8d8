"""Exported disparity and flow as other programs read them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.image_codecs import encode_passes
from datasets_manifest.storage.layout import passes_file
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.writer import encode_files, write_frame
from datasets_manifest.types.frame import FrameSpec
from geometry.se3 import exp_twist
from geometry.stereo import EYES
from labelgen.dense_matches import SurfacePasses, flow_matches, stereo_matches
from labelgen.export.annotations.dense_matching import UNKNOWN_FLOW_PX
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import Pair
from tests.support.recipe_builder import RIG_160_PX, RecipeTable, build_recipe, stations
from tests.support.small_datasets import SWINGING

BASE: RecipeTable = {"name": "dense", "seed": 3, "rig": RIG_160_PX, "outputs": {"exr": True}}
# The third pair of the sequence could not be made.
PLACES = (0, 1, 3, 4, 5)


def write_dataset(folder: Path, recipe: Recipe, pairs: list[Pair]) -> Path:
    """A dataset with passes."""
    for pair in pairs:
        eyes = {eye: getattr(pair.radiance, eye) for eye in EYES}
        files = encode_files(pair.images, {eye: seen.part_id for eye, seen in eyes.items()})
        files |= {passes_file(eye): encode_passes(seen) for eye, seen in eyes.items()}
        write_frame(folder, pair.record, files)
    write_manifest(folder, build_manifest(folder, recipe, "1", {0: "val"}))
    return folder


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    """A drogue that comes nearer from pair to pair, level with the horizon, over ground that passes by."""
    first = sample_frame(build_recipe(BASE, frames={"count": 1}, distance=stations(3.0)), 0)
    made = []
    for place in PLACES:
        step = exp_twist([0.01 * place, 0.0, -0.1 * place, 0.0, 0.01 * place, 0.0])
        changes = {
            "frame_index": place,
            "sequence_id": 0,
            "time_s": 0.1 * place,
            "left_from_drogue": step @ first.left_from_drogue,
            "environment": first.environment.model_copy(update={"camera_offset_m": (4.0 * place, 0.0)}),
        }
        made.append(Pair(first.model_copy(update=changes)))
    return made


@pytest.fixture(scope="module")
def dataset(pairs: list[Pair], tmp_path_factory: pytest.TempPathFactory) -> Path:
    recipe = build_recipe(BASE, frames=SWINGING["frames"], sequence=SWINGING["sequence"])
    return write_dataset(tmp_path_factory.mktemp("dense") / "dataset", recipe, pairs)


def passes(pair: Pair, eye: str) -> SurfacePasses:
    seen = getattr(pair.radiance, eye)
    return SurfacePasses(seen.part_id, seen.depth_m, seen.normal)


def frames(pairs: list[Pair]) -> list[FrameSpec]:
    return [pair.frame for pair in pairs]


def test_sintel_files_are_the_flow_between_neighbours(dataset: Path, pairs: list[Pair], tmp_path: Path) -> None:
    log = ExportLog()
    write_export("sintel", dataset, tmp_path / "out", log)
    root = tmp_path / "out" / "validation"
    names = {str(path.relative_to(root)) for path in root.rglob("*.*")}
    eyes = [f"sequence_0000{part}_{eye}" for eye in EYES for part in ("", "_part_2")]
    assert {name for name in names if name.startswith("final")} == {
        f"final/{eye}/frame_{number:04d}.png" for eye in eyes for number in range(1, 4 if "part" in eye else 3)
    }
    assert {name for name in names if name.startswith("flow")} == {
        f"flow/{eye}/frame_{number:04d}.flo" for eye in eyes for number in range(1, 3 if "part" in eye else 2)
    }
    unknown = 0
    for eye in EYES:
        # The pairs 3 and 4, after the gap.
        found = flow_matches(pairs[2].frame, pairs[3].frame, eye, passes(pairs[2], eye), passes(pairs[3], eye))
        name = f"sequence_0000_part_2_{eye}/frame_0001"
        flow = cv2.readOpticalFlow(str(root / "flow" / f"{name}.flo"))
        np.testing.assert_array_equal(flow[found.known], found.displacement_px[found.known].astype(np.float32))
        assert (flow[~found.known] == np.float32(UNKNOWN_FLOW_PX)).all()
        masks = {"occlusions": found.hidden, "outofframe": found.outside, "invalid": ~found.known}
        for kind, wanted in masks.items():
            mask = cv2.imread(str(root / kind / f"{name}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(mask, 255 * wanted.astype(np.uint8))
        assert found.known.any() and found.hidden.any()
    for path in (root / "invalid").rglob("*.png"):
        unknown += int((cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0).sum())
    (count,) = (count for what, count in log.losses.items() if "flow unknown" in what)
    assert count == unknown > 0


def test_middlebury_files_are_the_disparity(dataset: Path, pairs: list[Pair], tmp_path: Path) -> None:
    write_export("middlebury", dataset, tmp_path / "out", ExportLog())
    root = tmp_path / "out" / "validation"
    assert sorted(path.name for path in root.iterdir()) == [f"{place:06d}" for place in PLACES]
    rig, scene = pairs[3].frame.rig, root / "000004"
    lines = dict(line.split("=") for line in (scene / "calib.txt").read_text().splitlines())
    for number, eye in enumerate(EYES):
        other = EYES[1 - number]
        seen = passes(pairs[3], eye)
        found = stereo_matches(rig, eye, seen, passes(pairs[3], other))
        disparity = cv2.imread(str(scene / f"disp{number}.pfm"), cv2.IMREAD_UNCHANGED)
        assert disparity.dtype == np.float32 and disparity.max() < float(lines["ndisp"])
        # Middlebury's own formula for depth, in millimetres.
        focal_px = float(lines[f"cam{number}"].strip("[").split()[0])
        near = np.isfinite(seen.depth_m)
        depth_mm = float(lines["baseline"]) * focal_px / (disparity[near] + float(lines["doffs"]))
        np.testing.assert_allclose(depth_mm, 1000 * seen.depth_m[near], rtol=1e-5)
        np.testing.assert_allclose(disparity[~near], 0.0, atol=1e-9)
        mask = cv2.imread(str(scene / f"mask{number}nocc.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, np.where(found.matched, 255, 128))
        assert set(np.unique(mask)) == {128, 255}
        assert cv2.imread(str(scene / f"im{number}.png")).shape == (120, 160, 3)


@pytest.mark.parametrize("name", ["sintel", "middlebury"])
def test_datasets_without_depth_are_refused(name: str, pairs: list[Pair], tmp_path: Path) -> None:
    recipe = build_recipe(BASE, frames=SWINGING["frames"], sequence=SWINGING["sequence"], outputs={"exr": False})
    write_dataset(tmp_path / "dataset", recipe, pairs[:1])
    with pytest.raises(ValueError, match="has no depth; render its recipe again with `exr = true` in"):
        write_export(name, tmp_path / "dataset", tmp_path / "out", ExportLog())
    assert not (tmp_path / "out").exists()


def test_flow_of_single_pairs_is_refused(pairs: list[Pair], tmp_path: Path) -> None:
    recipe = build_recipe(BASE, frames={"count": 6}, distance=stations(3.0))
    write_dataset(tmp_path / "dataset", recipe, pairs[:1])
    with pytest.raises(ValueError, match="has single pairs, which nothing moves between"):
        write_export("sintel", tmp_path / "dataset", tmp_path / "out", ExportLog())


def test_disparity_of_real_lenses_is_refused(pairs: list[Pair], tmp_path: Path) -> None:
    lenses = build_recipe(BASE, rig={**RIG_160_PX, "preset": "paper-real"}, frames={"count": 6}, distance=stations(3.0))
    frame = pairs[0].frame.model_copy(update={"rig": lenses.rig})
    write_dataset(tmp_path / "dataset", lenses, [Pair(frame)])
    with pytest.raises(ValueError, match=r"images of real lenses, .*; render the recipe with a rig without lenses"):
        write_export("middlebury", tmp_path / "dataset", tmp_path / "out", ExportLog())
