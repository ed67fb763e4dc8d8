"""SPEED+ and KITTI exports, projected by OpenCV and by KITTI's own definition of a box."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.appearance import DrogueCondition, SurfaceCondition
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parts import Part
from geometry.se3 import RigidTransform, rotation_from_angles
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.keypoints import view_of
from labelgen.export.poses.kitti import kitti_label
from labelgen.part_pixels import drogue_hull_m, drogue_mask
from tests.support.drawn_pairs import Pair


def rotation_of_scalar_first(quaternion: list[float]) -> np.ndarray:
    """Hamilton's formula, written out: the matrix that turns vectors."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize(
    ("preset", "rig"),
    [
        ("rgb-ideal", {}),
        ("paper-real", {"eyes": {"k1": [-0.1, -0.1], "right_rotation_deg": 0.5, "principal_point_px": 3}}),
    ],
)
def test_speed_poses_project_markers_where_the_labels_have_them(
    preset: str, rig: dict[str, dict[str, Any]], dataset_by_preset: Callable[..., Any], tmp_path: Path
) -> None:
    dataset = dataset_by_preset(preset, rig)
    write_export("speed", dataset, tmp_path / "out", ExportLog())
    source, seen = Dataset(dataset), 0
    for eye in EYES:
        camera = json.loads((tmp_path / "out" / eye / "camera.json").read_text())
        matrix = np.array(camera["cameraMatrix"])
        assert (camera["Nu"], camera["Nv"]) == (160, 120)
        assert matrix[:2, 2].tolist() == [camera["ccx"], camera["ccy"]]
        np.testing.assert_allclose(np.diag(matrix)[:2], [camera["fx"] / camera["ppx"], camera["fy"] / camera["ppy"]])
        lists = sorted((tmp_path / "out" / eye).glob("*.json"))
        for entry in itertools.chain(*(json.loads(path.read_text()) for path in lists if path.stem != "camera")):
            assert (tmp_path / "out" / eye / "images" / entry["filename"]).is_file()
            record = source.record(int(entry["filename"][3:9]))
            turn, _ = cv2.Rodrigues(rotation_of_scalar_first(entry["q_vbs2tango_true"]))
            places, _ = cv2.projectPoints(
                marker_layout(record.frame.drogue).centers_m,
                turn,
                np.array(entry["r_Vo2To_vbs_true"]),
                matrix,
                np.array(camera["distCoeffs"]),
            )
            want = [marker.center_proj_px for marker in view_of(record, eye).markers]
            # Float64 through a quaternion and back.
            np.testing.assert_allclose(places[:, 0], want, atol=1e-7)
            seen += 1
    with_drogue = sum(source.record(index).left_from_drogue is not None for index in source.frame_indices)
    assert seen == 2 * with_drogue > 0


def test_speed_tells_of_images_without_a_pose(mixed_dataset: Path, tmp_path: Path) -> None:
    log = ExportLog()
    write_export("speed", mixed_dataset, tmp_path / "out", log)
    empty = Dataset(mixed_dataset).manifest.counts.empty
    assert log.losses["images without a drogue: among the images, but in no list, for they have no pose"] == 2 * empty
    assert len(list((tmp_path / "out").rglob("*.png"))) == 18


def kitti_corners(numbers: list[float]) -> np.ndarray:
    """(8, 3) corners of a label's box by the formula of KITTI's development kit (`computeBox3D`)."""
    height, width, length = numbers[8:11]
    x = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * length / 2
    y = np.array([0, 0, 0, 0, -1, -1, -1, -1]) * height
    z = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * width / 2
    cos, sin = np.cos(numbers[14]), np.sin(numbers[14])
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return (turn @ np.stack([x, y, z])).T + numbers[11:14]


def test_kitti_box_of_a_drogue_that_only_yaws_is_exact(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    pose = RigidTransform(rotation_from_angles(0.0, np.radians(25.0), 0.0), pair.record.left_from_drogue.translation_m)
    draw = type(pair)
    record = draw(pair.frame.model_copy(update={"left_from_drogue": pose})).record
    for eye in EYES:
        numbers = [0.0, *map(float, kitti_label(record, eye, None).split()[1:])]
        hull = drogue_hull_m(record.frame.drogue)
        corners = np.array(list(itertools.product(*zip(hull.min(axis=0), hull.max(axis=0), strict=True))))
        want = pose.apply(corners)
        gaps = np.linalg.norm(kitti_corners(numbers)[:, None] - want[None], axis=-1).min(axis=0)
        assert gaps.max() < 1e-9
        # The angle at which the eye sees it: none where the drogue's hose points straight along the ray.
        middle = want.mean(axis=0) - record.frame.rig.eye_offset_m(eye)
        np.testing.assert_allclose(numbers[3], numbers[14] - np.arctan2(middle[0], middle[2]), atol=1e-12)


def kitti_occlusion(record: PairRecord, part_id: np.ndarray | None) -> int:
    return int(kitti_label(record, "left", part_id).split()[2])


def test_kitti_counts_what_hides_the_drogue_by_its_pixels(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    part_id = pair.radiance.left.part_id
    rows, columns = np.nonzero(drogue_mask(part_id, pair.record.frame.drogue.marker_count))
    for hidden, level in ((0.0, 0), (0.005, 0), (0.02, 1), (0.45, 1), (0.55, 2)):
        behind = part_id.copy()
        count = int(hidden * len(rows))
        behind[rows[:count], columns[:count]] = Part.OBSTACLE
        assert kitti_occlusion(pair.record, behind) == level


def test_kitti_counts_no_missing_marker_as_hidden(full_pairs: list[Pair]) -> None:
    record = full_pairs[0].record
    off, *others = record.views.left.markers
    gone = {"markers": (off.model_copy(update={"visible_fraction": 0.0}), *others)}
    left = record.views.left.model_copy(update=gone)
    hidden = record.model_copy(update={"views": record.views.model_copy(update={"left": left})})
    assert kitti_occlusion(hidden, None) == 1
    conditions = (SurfaceCondition(missing=True), *(SurfaceCondition() for _ in others))
    frame = record.frame.model_copy(update={"condition": DrogueCondition(markers=conditions)})
    missing = hidden.model_copy(update={"frame": frame})
    assert kitti_occlusion(missing, None) == kitti_occlusion(missing, full_pairs[0].radiance.left.part_id) == 0
    bare = left.model_copy(update={"markers": ()})
    views = record.views.model_copy(update={"left": bare})
    assert kitti_occlusion(record.model_copy(update={"views": views}), None) == 3


def test_kitti_boxes_and_calibration(mixed_dataset: Path, tmp_path: Path) -> None:
    write_export("kitti", mixed_dataset, tmp_path / "out", ExportLog())
    training, source = tmp_path / "out" / "training", Dataset(mixed_dataset)
    truncated = []
    for index in source.frame_indices:
        record, name = source.record(index), f"{index:06d}"
        lines = (training / "calib" / f"{name}.txt").read_text().splitlines()
        calib = {line.split(":")[0]: np.array(line.split()[1:], dtype=float) for line in lines}
        second, third = calib["P2"].reshape(3, 4), calib["P3"].reshape(3, 4)
        assert third[0, 3] == pytest.approx(-266.0 * 0.12) and not second[:, 3].any()
        for eye, number, projection in (("left", 2, second), ("right", 3, third)):
            view = view_of(record, eye)
            assert (training / f"image_{number}" / f"{name}.png").is_file()
            labels = (training / f"label_{number}" / f"{name}.txt").read_text().splitlines()
            assert len(labels) == (view.box_visible_xywh_px is not None)
            for label in labels:
                fields = label.split()
                assert fields[0] == "drogue" and len(fields) == 15
                numbers = [0.0, *map(float, fields[1:])]
                rows, columns = np.nonzero(sees_drogue(source.part_ids(index, eye)))
                assert numbers[4:8] == [columns.min(), rows.min(), columns.max(), rows.max()]
                truncated.append((view.truncated, numbers[1]))
                seen = projection @ np.append(numbers[11:14], 1.0)
                u, v = seen[:2] / seen[2]
                x, y, width, height = view.box_full_xywh_px
                assert x < u < x + width and abs(v - (y + height)) < 0.25 * height
    for cut, fraction in truncated:
        assert (fraction > 0) == cut and 0 <= fraction < 1
    assert any(cut for cut, _ in truncated)


def sees_drogue(part_id: np.ndarray) -> np.ndarray:
    """Pixels that belong to the drogue's box: all parts but sky and what stands around."""
    mask: np.ndarray = ((part_id >= 1) & (part_id <= 6)) | (part_id >= 32)
    return mask


def test_kitti_refuses_eyes_that_are_not_rectified(dataset_by_preset: Callable[..., Any], tmp_path: Path) -> None:
    dataset = dataset_by_preset("paper-real", {"eyes": {"k1": [-0.1, -0.1]}})
    with pytest.raises(ValueError, match="KITTI holds those of pinholes only"):
        write_export("kitti", dataset, tmp_path / "out", ExportLog())
    assert not (tmp_path / "out").exists()
