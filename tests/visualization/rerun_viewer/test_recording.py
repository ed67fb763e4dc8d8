"""What a recording holds, read back with rerun's own reader."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage import layout
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, write_estimates
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from geometry.se3 import RigidTransform, rotation_from_angles
from tests.support.recipe_builder import recipe_text
from tests.support.rerun_files import entities, shown_values, static_value, values
from tests.support.small_datasets import SINGLE_PAIRS, docking_recipe, rendered

MANY_EMPTY = recipe_text(SINGLE_PAIRS, seed=3, frames={"count": 8, "empty_fraction": 0.4})
METHOD = "joint+filter/2"
LOST = 3
OFFSET_M = np.array([0.003, 0.0, 0.004])
TURN_DEG = 2.0


@pytest.fixture(scope="module")
def docking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(docking_recipe(sequences=1), tmp_path_factory.mktemp("docking") / "dataset")


@pytest.fixture(scope="module")
def estimates(docking: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """5 mm and 2 degrees of yaw off, in all but one pair."""
    path, dataset = tmp_path_factory.mktemp("estimates") / "e.jsonl", Dataset(docking)
    found: list[Estimate] = []
    for index in dataset.frame_indices:
        record = dataset.record(index)
        if index == LOST:
            found.append(NoFix(frame_index=index, method=METHOD, reason="nothing seen"))
            continue
        angles = np.deg2rad([record.pitch_deg, record.yaw_deg + TURN_DEG, record.roll_deg])
        moved = RigidTransform(rotation_from_angles(*angles), record.left_from_drogue.translation_m + OFFSET_M)
        found.append(PoseEstimate(frame_index=index, method=METHOD, left_from_drogue=moved))
    write_estimates(path, found)
    return path


@pytest.fixture(scope="module")
def recording(docking: Path, estimates: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "new" / "a.rrd"
    assert run(["view", str(docking), "--estimates", str(estimates), "--save", str(path)]) == DONE
    assert [file.name for file in path.parent.iterdir()] == ["a.rrd"]
    return path


def entity_of_method(path: Path, before: str) -> str:
    """However rerun writes a name with signs in it."""
    below = {entity for entity in entities(path) if entity.startswith(before)}
    (found,) = {entity for entity in below if not entity.endswith("/body")}
    return found


def static(path: Path, entity: str, component: str) -> np.ndarray:
    """What does not change."""
    return np.array(static_value(path, entity, component), dtype=float)


def test_true_and_estimated_poses_are_those_of_the_files(docking: Path, recording: Path) -> None:
    dataset = Dataset(docking)
    poses = values(recording, "/rig/drogue", "Translation3D"), values(recording, "/rig/drogue", "TransformMat3x3")
    estimated = values(recording, entity_of_method(recording, "/rig/estimates/"), "Translation3D")
    assert sorted(poses[0]) == list(dataset.frame_indices)
    for index in dataset.frame_indices:
        pose = dataset.record(index).left_from_drogue
        # The viewer keeps float32, and matrices by their columns.
        np.testing.assert_allclose(poses[0][index][0], pose.translation_m, rtol=1e-6)
        np.testing.assert_allclose(np.reshape(poses[1][index][0], (3, 3)).T, pose.rotation, atol=1e-6)
        if index != LOST:
            np.testing.assert_allclose(estimated[index][0], pose.translation_m + OFFSET_M, rtol=1e-6)
    assert LOST not in estimated
    # Where there is no fix nothing is shown, and then the drogue's circles are sent again.
    circles = values(recording, entity_of_method(recording, "/rig/estimates/") + "/body", "LineStrip3D")
    assert sorted(circles) == [0, 4]
    rim = np.array(circles[0][0])
    radius_m = dataset.record(0).frame.drogue.rim_radius_m
    # The viewer keeps float32.
    np.testing.assert_allclose(np.linalg.norm(rim, axis=1), radius_m, rtol=1e-6)
    np.testing.assert_array_equal(rim[0], rim[-1])


def test_curves_are_the_errors_and_stop_where_there_is_no_fix(recording: Path) -> None:
    for curve, wanted in (("position_mm", 5.0), ("pitch_deg", 0.0), ("yaw_deg", TURN_DEG)):
        curve_values = values(recording, entity_of_method(recording, f"/errors/{curve}/"), "Scalar")
        assert sorted(curve_values) == [0, 1, 2, 4, 5]
        # Poses are rounded nowhere: what is left is floating point.
        np.testing.assert_allclose([value[0] for value in curve_values.values()], wanted, atol=1e-6)


def test_boxes_and_markers_count_from_the_corner_of_the_image(docking: Path, recording: Path) -> None:
    dataset = Dataset(docking)
    for eye in ("left", "right"):
        centers = values(recording, f"/rig/{eye}/box_full", "Position2D")
        halves = values(recording, f"/rig/{eye}/box_full", "HalfSize2D")
        markers = values(recording, f"/rig/{eye}/markers", "Position2D")
        for index in dataset.frame_indices:
            view = getattr(dataset.record(index).views, eye)
            x, y, width, height = view.box_full_xywh_px
            # Half a pixel more than the dataset's; float32 of some hundred pixels.
            np.testing.assert_allclose(centers[index][0], [x + width / 2 + 0.5, y + height / 2 + 0.5], atol=1e-3)
            np.testing.assert_allclose(halves[index][0], [width / 2, height / 2], atol=1e-3)
            seen = [m.center_ellipse_px for m in view.markers if m.visible_fraction > 0]
            np.testing.assert_allclose(markers.get(index, []), np.reshape(seen, (-1, 2)) + 0.5, atol=1e-3)


def test_the_pinholes_project_the_mesh_to_the_box(docking: Path, recording: Path) -> None:
    record = Dataset(docking).record(0)
    # The mesh is sent once for as long as the drogue is there.
    (vertices,) = values(recording, "/rig/drogue/body", "Position3D").values()
    points = record.left_from_drogue.apply(np.array(vertices))
    for eye, view in (("left", record.views.left), ("right", record.views.right)):
        matrix = static(recording, f"/rig/{eye}", "PinholeProjection").reshape(3, 3).T
        seen = (points - static(recording, f"/rig/{eye}", "Translation3D")) @ matrix.T
        image = seen[:, :2] / seen[:, 2:]
        x, y, width, height = view.box_full_xywh_px
        corners = [x + 0.5, y + 0.5, x + width + 0.5, y + height + 0.5]
        # Chords of the rim's 256 sides leave it by 0.004 px at this size; the numbers are float32.
        np.testing.assert_allclose([*image.min(axis=0), *image.max(axis=0)], corners, atol=0.02)


def test_images_are_there(docking: Path, recording: Path) -> None:
    images = values(recording, "/rig/right/image", "Blob")
    assert len(images) == 6
    picture = cv2.imdecode(np.array(images[0][0], dtype=np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (120, 160, 3)


def test_a_part_and_a_damaged_pair(docking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    damaged, out = tmp_path / "damaged", tmp_path / "a.rrd"
    shutil.copytree(docking, damaged)
    image = layout.frame_folder(damaged, 2) / "left.png"
    image.write_bytes(image.read_bytes()[:500])
    assert run(["view", str(damaged), "--frames", "1:4", "--save", str(out)]) == FAULT
    heard = capsys.readouterr()
    assert f"frame 2 is left out: {image}" in heard.err and heard.out == f"wrote {out}: 2 pairs\n"
    assert sorted(values(out, "/rig/left/image", "Blob")) == [1, 3]


def test_without_a_pair_to_show_nothing_is_written(
    docking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged, out = tmp_path / "damaged", tmp_path / "a.rrd"
    shutil.copytree(docking, damaged)
    for index in range(6):
        (layout.frame_folder(damaged, index) / "left.png").write_bytes(b"")
    assert run(["view", str(damaged), "--save", str(out)]) == FAULT
    heard = capsys.readouterr()
    assert heard.out == "" and heard.err.count("is left out") == 6
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


def test_the_distance_stops_where_there_is_no_drogue(tmp_path: Path) -> None:
    rendered(MANY_EMPTY, tmp_path / "dataset")
    out = tmp_path / "a.rrd"
    assert run(["view", str(tmp_path / "dataset"), "--save", str(out)]) == DONE
    dataset = Dataset(tmp_path / "dataset")
    truth = {index: dataset.record(index).conditions.distance_m for index in dataset.frame_indices}
    there = {index: distance_m for index, distance_m in truth.items() if distance_m is not None}
    assert 0 < len(there) < 8
    shown = shown_values(out, "/distance_m", "Scalar", dataset.frame_indices)
    assert {index: value[0] for index, value in shown.items()} == pytest.approx(there)


def test_frames_that_the_dataset_lacks_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rendered(MANY_EMPTY, tmp_path / "dataset", (0, 7))
    assert run(["view", str(tmp_path / "dataset"), "--frames", "2:5", "--save", str(tmp_path / "a.rrd")]) == WRONG_INPUT
    assert "--frames: the dataset holds none of these pairs, got 2:5" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["dataset"]


def test_a_viewer_without_a_window_is_one_clear_line(
    docking: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ours is started and asked, whatever else listens on this machine."""
    monkeypatch.setenv("DISPLAY", ":nowhere")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert run(["view", str(docking)]) == WRONG_INPUT
    assert "the viewer does not open; write a recording with --save FILE.rrd" in capfd.readouterr().err


def test_pairs_without_truth(docking: Path, estimates: Path, tmp_path: Path) -> None:
    blind, out = tmp_path / "blind", tmp_path / "a.rrd"
    assert run(["export", str(docking), "--format", "blind", "--out", str(blind)]) == DONE
    assert run(["view", str(blind), "--estimates", str(estimates), "--save", str(out)]) == DONE
    held = entities(out)
    assert "/rig/left/image" in held and "/rig/drogue" not in held
    assert sorted(values(out, entity_of_method(out, "/rig/estimates/"), "Translation3D")) == [0, 1, 2, 4, 5]


def test_wrong_orders_are_refused_on_one_line(
    docking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    out = str(tmp_path / "a.rrd")
    cases = [
        ([], "there is no screen here to open the viewer on; write a recording with --save FILE.rrd"),
        (["--save", "a.mp4"], "--save: must end in .rrd, got a.mp4"),
        (["--save", "s3://bucket/a.rrd"], "--save: must be a folder or file of this machine, got s3://bucket/a.rrd"),
        (["--save", "/proc/nowhere/a.rrd"], "/proc/nowhere/a.rrd: cannot be written"),
        (["--save", out, "--frames", "6:9"], "--frames: must name frames"),
        (["--save", out, "--estimates", str(tmp_path / "none.jsonl")], "none.jsonl: cannot be read"),
    ]
    for arguments, fault in cases:
        assert run(["view", str(docking), *arguments]) == WRONG_INPUT, arguments
        heard = capsys.readouterr().err
        assert fault in heard and heard.count("\n") == 1, heard
    assert list(tmp_path.iterdir()) == []


def test_without_rerun_there_is_one_clear_line(
    docking: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert run(["view", str(docking), "--save", str(tmp_path / "a.rrd")]) == WRONG_INPUT
    assert capsys.readouterr().err == ("droguekit: error: view: rerun is not installed; pip install 'droguekit[viz]'\n")
