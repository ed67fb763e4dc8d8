from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.storage.image_codecs import encode_passes
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import encode_files, write_frame
from drogue_models.parts import drogue_part_ids
from drogue_models.presets import load_drogue
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, Eye
from labelgen.export.export_log import ExportLog
from labelgen.export.poses.bop import depth_numbers, model_info, write_bop
from tests.support.display_encoding import shown
from tests.support.drawn_pairs import Pair
from tests.support.recipe_builder import build_recipe, stations

SPLITS = ("train", "val", "test")
FOLDERS = {"train": "train_pbr", "val": "val", "test": "test"}


@pytest.fixture(scope="module")
def deep_dataset(tmp_path_factory: pytest.TempPathFactory, small_recipe: Recipe, pairs: list[Pair]) -> Path:
    """A dataset with EXR files."""
    folder = tmp_path_factory.mktemp("deep") / "dataset"
    recipe = small_recipe.model_copy(update={"outputs": small_recipe.outputs.model_copy(update={"exr": True})})
    for pair in pairs:
        seen = {eye: getattr(pair.radiance, eye) for eye in EYES}
        files = encode_files(pair.images, {eye: passes.part_id for eye, passes in seen.items()})
        write_frame(folder, pair.record, files | {f"{eye}.exr": encode_passes(passes) for eye, passes in seen.items()})
    write_manifest(
        folder,
        build_manifest(
            folder, recipe, "1", {scene_id: SPLITS[scene_id % 3] for scene_id in range(recipe.frames.scenes)}
        ),
    )
    return folder


@pytest.fixture(scope="module")
def bop(deep_dataset: Path) -> Path:
    """Its export, which no test may change."""
    write_bop(deep_dataset, deep_dataset.with_name("bop"), ExportLog())
    return deep_dataset.with_name("bop")


def scene_of(bop: Path, pair: Pair) -> Path:
    return bop / FOLDERS[SPLITS[pair.frame.scene_id % 3]] / f"{pair.frame.scene_id:06d}"


def table_of(bop: Path, pair: Pair, name: str, eye: Eye) -> Any:
    return json.loads((scene_of(bop, pair) / f"{name}_{eye}.json").read_text())[str(pair.frame.frame_index)]


def mssd_mm(estimate: np.ndarray, truth: np.ndarray, points_mm: np.ndarray, symmetries: list[np.ndarray]) -> float:
    """Maximum symmetry-aware surface distance. [mm]

    Source: Hodan et al. 2020, "BOP Challenge 2020 on 6D Object Localization", eq. 1: the least over the symmetries of
    the largest distance between corresponding vertices.
    """
    seen = points_mm @ estimate[:3, :3].T + estimate[:3, 3]
    return min(
        np.linalg.norm(seen - (points_mm @ turned[:3, :3].T + turned[:3, 3]), axis=1).max()
        for turned in (truth @ symmetry for symmetry in symmetries)
    )


def mspd_px(
    estimate: np.ndarray, truth: np.ndarray, points_mm: np.ndarray, symmetries: list[np.ndarray], matrix: np.ndarray
) -> float:
    """Maximum symmetry-aware projection distance, eq. 2 of the same. [px]"""

    def project(pose: np.ndarray) -> np.ndarray:
        image = (points_mm @ pose[:3, :3].T + pose[:3, 3]) @ matrix.T
        return image[:, :2] / image[:, 2:]

    seen = project(estimate)
    return min(np.linalg.norm(seen - project(truth @ symmetry), axis=1).max() for symmetry in symmetries)


def roll(degrees: float) -> np.ndarray:
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, np.radians(degrees)]))[0]
    return turn


def test_poses_score_nothing_on_truth_and_under_a_roll_by_a_marker(bop: Path, full_pairs: list[Pair]) -> None:
    points_mm = np.asarray(trimesh.load(bop / "models" / "obj_000001.ply", process=False).vertices)
    info = json.loads((bop / "models" / "models_info.json").read_text())["1"]
    symmetries = [np.eye(4), *(np.array(entry).reshape(4, 4) for entry in info["symmetries_discrete"])]
    assert len(symmetries) == 8
    for pair in full_pairs:
        for eye in EYES:
            (truth,) = table_of(bop, pair, "scene_gt", eye)
            matrix = np.array(table_of(bop, pair, "scene_camera", eye)["cam_K"]).reshape(3, 3)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = np.reshape(truth["cam_R_m2c"], (3, 3)), truth["cam_t_m2c"]
            for estimate in (pose, pose @ roll(45.0), pose @ roll(-90.0)):
                # Metres in float64, in millimetres and through a few products.
                assert mssd_mm(estimate, pose, points_mm, symmetries) < 1e-8
                assert mspd_px(estimate, pose, points_mm, symmetries, matrix) < 1e-9
            # The rim, 330 mm from the axis, turned by half a marker's turn.
            assert mssd_mm(pose @ roll(22.5), pose, points_mm, symmetries) == pytest.approx(
                2 * 330 * np.sin(np.radians(11.25)), rel=1e-3
            )
            # The projection of the marker's centre in the drogue frame is where the record has it.
            first_mm = np.array([0.0, 270.0, 0.0])
            image = matrix @ (pose[:3, :3] @ first_mm + pose[:3, 3])
            view = getattr(pair.record.views, eye)
            np.testing.assert_allclose(image[:2] / image[2], view.markers[0].center_proj_px, atol=1e-9)


def test_models_without_markers_have_the_symmetry_of_their_body() -> None:
    points_mm = np.random.default_rng(1).uniform(-300, 300, (20, 3))
    (half_turn,) = model_info(load_drogue("basket-grey"), points_mm)["symmetries_discrete"]
    np.testing.assert_allclose(np.reshape(half_turn, (4, 4)), np.diag([-1, -1, 1, 1]), rtol=0, atol=1e-15)
    round_cone = model_info(load_drogue("cone-orange"), points_mm)
    assert round_cone["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    assert "symmetries_discrete" not in round_cone
    assert "symmetries_continuous" not in model_info(load_drogue("red-8"), points_mm)


def test_models_are_measured_in_millimetres(bop: Path) -> None:
    mesh = trimesh.load(bop / "models" / "obj_000001.ply", process=False)
    for name in ("models", "models_eval"):
        info = json.loads((bop / name / "models_info.json").read_text())["1"]
        low, high = mesh.bounds
        # The file holds float32.
        np.testing.assert_allclose([info[f"min_{axis}"] for axis in "xyz"], low, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose([info[f"size_{axis}"] for axis in "xyz"], high - low, rtol=1e-6)
        # The rim is 660 mm wide, the drogue 450 mm long: from the rim to the end of the coupling it is less.
        assert info["diameter"] == pytest.approx(660, abs=0.1)


def test_masks_boxes_and_counts_agree(bop: Path, full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        for eye in EYES:
            scene, index = scene_of(bop, pair), pair.frame.frame_index
            whole, visible = (
                cv2.imread(str(scene / f"{name}_{eye}" / f"{index:06d}_000000.png"), cv2.IMREAD_UNCHANGED)
                for name in ("mask", "mask_visib")
            )
            (info,) = table_of(bop, pair, "scene_gt_info", eye)
            np.testing.assert_array_equal(
                visible == 255, np.isin(getattr(pair.radiance, eye).part_id, drogue_part_ids(8))
            )
            assert (
                info["px_count_all"] == np.count_nonzero(whole) >= info["px_count_visib"] == np.count_nonzero(visible)
            )
            assert info["visib_fract"] == info["px_count_visib"] / info["px_count_all"] > 0.9
            for key, mask in (("bbox_obj", whole), ("bbox_visib", visible)):
                rows, columns = np.nonzero(mask)
                assert info[key] == [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)]


def test_what_leaves_the_image_counts_for_the_whole(
    full_pairs: list[Pair], small_recipe: Recipe, tmp_path: Path
) -> None:
    frame, make = full_pairs[0].frame, type(full_pairs[0])
    camera, pose = frame.rig.camera, frame.left_from_drogue
    # The drogue's middle on the left border.
    middle_m = np.array([-camera.cx_px / camera.fx_px * pose.translation_m[2], 0.0, pose.translation_m[2]])
    cut = frame.model_copy(update={"left_from_drogue": replace(pose, translation_m=middle_m)})
    pair = make(cut)
    assert pair.record.views.left.truncated
    files = encode_files(pair.images, {eye: getattr(pair.radiance, eye).part_id for eye in EYES})
    write_frame(tmp_path / "dataset", pair.record, files)
    write_manifest(
        tmp_path / "dataset",
        build_manifest(
            tmp_path / "dataset", small_recipe, "1", dict.fromkeys(range(small_recipe.frames.scenes), "val")
        ),
    )
    write_bop(tmp_path / "dataset", tmp_path / "bop", ExportLog())
    (info,) = json.loads(next((tmp_path / "bop").rglob("scene_gt_info_left.json")).read_text())[str(cut.frame_index)]
    wide = PinholeCamera(
        3 * camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px + camera.width_px, camera.cy_px
    )
    whole = make(cut.model_copy(update={"rig": replace(frame.rig, camera=wide)}))
    count = np.isin(whole.radiance.left.part_id, drogue_part_ids(8)).sum()
    # A ray that passes on an edge may be decided otherwise.
    assert info["px_count_all"] == pytest.approx(count, rel=0.01)
    assert info["px_count_valid"] < 0.7 * count and 0.4 < info["visib_fract"] < 0.7


def test_depth_images_are_the_dataset_s_depth(bop: Path, pairs: list[Pair]) -> None:
    for pair in pairs:
        for eye in EYES:
            seen = getattr(pair.radiance, eye)
            path = scene_of(bop, pair) / f"depth_{eye}" / f"{pair.frame.frame_index:06d}.png"
            numbers = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            scale = table_of(bop, pair, "scene_camera", eye)["depth_scale"]
            sky = ~np.isfinite(seen.depth_m)
            assert numbers.dtype == np.uint16 and (numbers[sky] == 0).all() and scale in (0.1, 1.0)
            # Half a number, and the rounding of float32 metres.
            np.testing.assert_allclose(numbers[~sky] * scale, seen.depth_m[~sky] * 1e3, atol=0.5 * scale + 1e-3)


def test_far_depth_takes_a_coarser_scale_and_what_is_beyond_is_unknown() -> None:
    near, scale = depth_numbers(np.array([[6.5, np.inf]], np.float32))
    assert scale == 0.1 and near.tolist() == [[65000, 0]]
    far, scale = depth_numbers(np.array([[6.5, 600.0]], np.float32))
    assert scale == 10.0 and far.tolist() == [[650, 60000]]
    lost, scale = depth_numbers(np.array([[10.0, 7000.0]], np.float32))
    assert scale == 100.0 and lost.tolist() == [[100, 0]]


def test_both_eyes_stand_apart_by_the_baseline(bop: Path, full_pairs: list[Pair]) -> None:
    for pair in full_pairs:
        centers = []
        for eye in EYES:
            camera = table_of(bop, pair, "scene_camera", eye)
            rotation = np.reshape(camera["cam_R_w2c"], (3, 3))
            centers.append(-rotation.T @ camera["cam_t_w2c"])
        assert np.linalg.norm(centers[1] - centers[0]) == pytest.approx(pair.frame.rig.baseline_m * 1e3, rel=1e-12)


def test_images_empty_frames_and_targets(bop: Path, pairs: list[Pair], deep_dataset: Path) -> None:
    targets = json.loads((bop / "test_targets_bop19.json").read_text())
    want = set()
    for pair in pairs:
        scene, index = scene_of(bop, pair), pair.frame.frame_index
        for eye in EYES:
            image = scene / f"rgb_{eye}" / f"{index:06d}.png"
            stored = cv2.imread(str(deep_dataset / "frames" / f"{index:06d}" / f"{eye}.png"))
            np.testing.assert_array_equal(cv2.imread(str(image)), shown(stored, Dataset(deep_dataset), index))
            count = 0 if pair.frame.drogue is None else 1
            assert len(table_of(bop, pair, "scene_gt", eye)) == len(table_of(bop, pair, "scene_gt_info", eye)) == count
        if pair.frame.drogue is not None and SPLITS[pair.frame.scene_id % 3] == "test":
            want.add((index, pair.frame.scene_id))
    assert {(target["im_id"], target["scene_id"]) for target in targets} == want
    assert all(target["obj_id"] == target["inst_count"] == 1 for target in targets)


def test_the_same_dataset_gives_the_same_bytes(bop: Path, deep_dataset: Path, tmp_path: Path) -> None:
    def contents(folder: Path) -> dict[Path, bytes]:
        return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    write_bop(deep_dataset, tmp_path / "again", ExportLog())
    assert contents(tmp_path / "again") == contents(bop)


def test_without_depth_the_rest_is_there_and_the_loss_is_told(small_dataset: Path, tmp_path: Path) -> None:
    log = ExportLog()
    write_bop(small_dataset, tmp_path / "bop", log)
    assert log.losses == {"depth images left out, for the dataset has no EXR files": 12}
    assert not list((tmp_path / "bop").rglob("depth_*")) and list((tmp_path / "bop").rglob("mask_visib_left"))


def test_real_lenses_are_refused(tmp_path: Path) -> None:
    recipe = build_recipe(name="real", rig="paper-real", frames={"count": 1}, distance=stations(5.0))
    write_manifest(
        tmp_path / "real",
        build_manifest(tmp_path / "real", recipe, "1", dict.fromkeys(range(recipe.frames.scenes), "train")),
    )
    with pytest.raises(ValueError, match="BOP holds those of pinholes only"):
        write_bop(tmp_path / "real", tmp_path / "out", ExportLog())
    assert not (tmp_path / "out").exists()
