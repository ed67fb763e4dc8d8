"""Truth of drogues with bodies, with markers at several depths and with none, against a plain z-buffer and OpenCV."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.types.estimates import NoFix
from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import Part
from drogue_models.presets import load_drogue
from droguekit.scoring.pose_benchmark import run_benchmark
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import FORMATS, write_export
from labelgen.validation.dataset_checks import validate_dataset
from labelgen.validation.label_checks import box_faults, check_against_passes, projection_faults
from nav.pose.method_registry import method_names
from nav.runner import navigate
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import Pair, write_drawn_dataset
from tests.support.recipe_builder import RIG_160_PX, RIG_320_PX, build_recipe, stations

ONE_OF_EACH = ("basket-orange-stripes", "basket-tube", "petals-metal", "ribbons-white", "cone-white", "cone-markers")


def frame_of(name: str) -> FrameSpec:
    recipe = build_recipe(
        name="bodies", seed=4, drogue=name, rig=RIG_320_PX, frames={"count": 1}, distance=stations(2.2),
        pose={"pitch_deg": [-9, 9], "yaw_deg": [-9, 9]}, environment={"clouds": {"scene_fraction": 0.0}},
    )  # fmt: skip
    return sample_frame(recipe, 0)


@pytest.mark.parametrize("name", [*ONE_OF_EACH, "basket-strut-markers"])
def test_labels_agree_with_the_pixels(name: str) -> None:
    pair = Pair(frame_of(name))
    record, drogue = pair.record, load_drogue(name)
    assert check_against_passes(record, pair.radiance) + projection_faults(record) + box_faults(record) == []
    for view, seen in ((record.views.left, pair.radiance.left), (record.views.right, pair.radiance.right)):
        assert len(view.markers) == drogue.marker_count
        full, visible = np.array(view.box_full_xywh_px), np.array(view.box_visible_xywh_px)
        # Nothing hides the drogue: each side of its box lies within a pixel of the outermost pixel's edge.
        ends = np.abs(np.concatenate([full[:2] - visible[:2], (full[:2] + full[2:]) - (visible[:2] + visible[2:])]))
        assert ends.max() <= 1.0
        assert np.count_nonzero(seen.part_id == Part.FACE) == 0
        if not drogue.marker_count:
            assert seen.part_id.max() < Part.HOSE


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_rim_circle_is_where_the_rim_is_drawn(name: str) -> None:
    pair = Pair(frame_of(name))
    pose, drogue, camera = pair.frame.left_from_drogue, load_drogue(name), pair.frame.rig.camera
    assert pose is not None
    angle = np.linspace(0.0, 2 * np.pi, 720)
    # The rim's tube is widest a tube's radius behind the rim plane.
    circle_m = np.stack([np.cos(angle), np.sin(angle), np.zeros(720)], axis=-1) * drogue.rim_radius_m
    circle_m[:, 2] = drogue.rim_tube_radius_m
    turn, _ = cv2.Rodrigues(pose.rotation)
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1.0]])
    want, _ = cv2.projectPoints(circle_m, turn, pose.translation_m, matrix, None)
    rows, columns = np.nonzero(pair.radiance.left.part_id == Part.RIM)
    drawn = np.stack([columns, rows], axis=-1)
    low, high = want[:, 0].min(axis=0), want[:, 0].max(axis=0)
    # Outermost pixel centres lie within a pixel of the outline.
    assert np.abs(drawn.min(axis=0) - low).max() <= 1.0
    assert np.abs(drawn.max(axis=0) - high).max() <= 1.0


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drogues without markers, with markers at two depths, and like the paper's, by turns."""
    variants = ["basket-grey", "basket-strut-markers", "red-8", "cone-white"]
    recipe = build_recipe(
        name="bodies", seed=6, drogue="basket-grey", rig=RIG_160_PX, frames={"count": 4, "scenes": 4, "in_turn": True},
        distance=stations(2.2), target={"variants": [{"drogue": name} for name in variants]},
        environment={"clouds": {"scene_fraction": 0.0}},
    )  # fmt: skip
    pairs = [Pair(sample_frame(recipe, index)) for index in range(recipe.frames.count)]
    return write_drawn_dataset(tmp_path_factory.mktemp("bodies") / "dataset", recipe, pairs)


def test_a_dataset_with_markerless_drogues_is_valid(dataset: Path) -> None:
    assert validate_dataset(dataset).faults == []


# `rosbag` needs sequences, and the formats of disparity and flow need depth, which drawn datasets lack.
@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("rosbag", "middlebury", "sintel")])
def test_every_format_takes_markerless_drogues(dataset: Path, tmp_path: Path, name: str) -> None:
    assert write_export(name, dataset, tmp_path / "out", ExportLog())


def test_markerless_drogues_have_boxes_and_absent_keypoints(dataset: Path) -> None:
    coco = json.loads((dataset / "annotations" / "all.json").read_text())
    first = next(entry for entry in coco["annotations"] if entry["image_id"] == 1)
    assert first["num_keypoints"] == 0 and set(first["keypoints"]) == {0}
    assert first["bbox"][2] > 10 and first["area"] > 100


def test_navigation_says_in_one_line_why_there_is_no_pose(dataset: Path, tmp_path: Path) -> None:
    blind = BlindDataset(dataset)
    estimates = list(navigate(blind, method_names(), detector="color-blob"))
    assert len(estimates) == 4 * len(method_names())
    for estimate in estimates:
        if estimate.frame_index in (0, 3):
            assert isinstance(estimate, NoFix)
            by_markers = "the drogue has no markers, a pose needs 3; joint-rim measures its rim"
            by_rim = "no drogue detected in the left image, nor in the right one"
            assert estimate.reason == (by_rim if estimate.method == "joint-rim" else by_markers)
    lines = tmp_path / "estimates.jsonl"
    lines.write_text("".join(estimate.model_dump_json() + "\n" for estimate in estimates))
    rows = json.loads(run_benchmark(dataset, lines).to_json())["methods"]
    assert set(rows) == set(method_names())


def test_the_analytic_engine_refuses_bodies_before_it_begins() -> None:
    table = {"name": "flat", "frames": {"count": 1}, "distance": stations(3.0), "render": {"engine": "analytic"}}
    build_recipe(table, drogue="red-8")
    with pytest.raises(ValueError, match=r"render\.engine: analytic draws flat rings only, not basket-grey"):
        build_recipe(table, drogue="basket-grey")
    with pytest.raises(ValueError, match="not cone-white, petals-dark; use mitsuba or blender"):
        build_recipe(table, target={"variants": [{"drogue": name} for name in ("petals-dark", "red-8", "cone-white")]})
