"""Limits of labels' errors against what a finer look at the exposure and at the pixels shows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from pycocotools.coco import COCO

from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from geometry.circles import disc_image_centers
from geometry.stereo import EYES, Eye
from labelgen.export.annotations.coco import write_coco
from labelgen.export.export_log import ExportLog
from labelgen.export.packages.parquet import write_parquet
from labelgen.label_errors import LabelErrors, confirmed_px, label_errors
from labelgen.part_pixels import drogue_box
from tests.support.drawn_pairs import Pair


def turning(pair: Pair, rate_rad_s: float, exposure_s: float) -> PairRecord:
    """The pair's record with a drogue that turns about the camera's axis and moves across the view."""
    twist = np.array([0.4, 0.0, 0.0, 0.0, 0.0, rate_rad_s])
    exposure = pair.frame.exposure.model_copy(update={"time_s": exposure_s})
    frame = pair.frame.model_copy(update={"drogue_twist_per_s": twist, "exposure": exposure})
    ends = {name: frame.left_from_drogue_at(at * exposure_s) for name, at in (("open", -0.5), ("close", 0.5))}
    changes = {f"left_from_drogue_{name}": pose for name, pose in ends.items()}
    return pair.record.model_copy(update={"frame": frame, **changes})


def limits(record: PairRecord, eye: Eye) -> LabelErrors:
    found = label_errors(record, eye)
    assert found is not None
    return found


@pytest.mark.parametrize("eye", EYES)
def test_limits_hold_the_mean_of_the_exposure_and_the_extent_at_all_times(full_pairs: list[Pair], eye: Eye) -> None:
    for pair in full_pairs[:2]:
        record = turning(pair, 25.0, 0.02)
        drogue, rig, found = record.frame.drogue, record.frame.rig, limits(record, eye)
        assert drogue is not None
        layout = marker_layout(drogue)
        radii = np.full(layout.count, layout.radius_m)
        times_s = np.linspace(-0.01, 0.01, 201)
        poses = [record.frame.left_from_drogue_at(time_s) for time_s in times_s]
        paths = np.stack([disc_image_centers(rig, pose, layout.centers_m, radii, eye) for pose in poses])
        shift = np.linalg.norm(paths.mean(axis=0) - paths[100], axis=-1)
        assert shift.max() > 0.01
        # A quarter of a radian is nearly a parabola: the next term is 1/30 of the square of half of it.
        np.testing.assert_allclose(found.markers_px, shift, rtol=0.05, atol=2e-4)
        boxes = np.array([drogue_box(drogue, rig, pose, eye) for pose in poses])
        sides = np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])
        assert (np.abs(sides - sides[100]).max(axis=0) <= np.array(found.box_full_px) + 0.02).all()
        assert np.array(found.box_full_px).max() > 0.1


def test_what_stands_still_errs_by_arithmetic_and_pixels_alone(full_pairs: list[Pair]) -> None:
    record = full_pairs[0].record
    pose = record.left_from_drogue
    still = record.model_copy(update={"left_from_drogue_open": pose, "left_from_drogue_close": pose})
    found = limits(still, "left")
    assert set(found.markers_px) == {1e-6} and found.hub_px == 1e-6
    assert found.box_full_px == (1e-6,) * 4 and found.box_visible_px == (0.5,) * 4


def test_empty_frames_have_no_limits(pairs: list[Pair]) -> None:
    empty = next(pair.record for pair in pairs if pair.frame.drogue is None)
    assert label_errors(empty, "left") is None


def test_part_ids_confirm_labels_and_tell_of_wrong_ones(full_pairs: list[Pair]) -> None:
    pair = full_pairs[0]
    part_id = pair.radiance.left.part_id
    confirmed = confirmed_px(pair.record, "left", part_id)
    seen = [index for index, marker in enumerate(pair.record.views.left.markers) if marker.visible_fraction == 1]
    assert seen and all((confirmed[index] is not None) == (index in seen) for index in range(len(confirmed)))
    markers = list(pair.record.views.left.markers)
    u, v = markers[seen[0]].center_ellipse_px
    markers[seen[0]] = markers[seen[0]].model_copy(update={"center_ellipse_px": (u + 3.0, v)})
    left = pair.record.views.left.model_copy(update={"markers": tuple(markers)})
    views = pair.record.views.model_copy(update={"left": left})
    wrong = confirmed_px(pair.record.model_copy(update={"views": views}), "left", part_id)[seen[0]]
    right = confirmed[seen[0]]
    assert right is not None and right < 1.0 and wrong is not None and 2.0 < wrong < 4.0


def test_exports_carry_the_limits(small_dataset: Path, full_pairs: list[Pair], tmp_path: Path) -> None:
    write_coco(small_dataset, tmp_path, ExportLog())
    write_parquet(small_dataset, tmp_path, ExportLog())
    coco = COCO(str(tmp_path / "all.json"))
    rows = pq.read_table(tmp_path / "views.parquet").to_pylist()
    for pair in full_pairs:
        found = limits(pair.record, "right")
        row = next(r for r in rows if r["frame_index"] == pair.frame.frame_index and r["view"] == "right")
        assert row["marker_center_error_px"] == list(found.markers_px)
        assert row["box_visible_error_px"] == list(found.box_visible_px)
        assert row["hub_center_error_px"] == found.hub_px
        image_id = 2 * pair.frame.frame_index + 2
        entries = coco.loadAnns(coco.getAnnIds(imgIds=[image_id]))
        own = next(entry["droguekit"] for entry in entries if entry["category_id"] == 1)
        assert own["bbox_error_px"] == list(found.box_visible_px)
        assert own["center_error_px"] == list(found.markers_px)
        for entry in (entry["droguekit"] for entry in entries if entry["category_id"] == 2):
            assert entry["center_error_px"] == found.markers_px[entry["marker_index"]]
            assert (entry["center_confirmed_px"] is not None) == (entry["visible_fraction"] == 1 and entry["in_image"])
    empty = [row for row in rows if not row["has_drogue"]]
    assert empty and all(row["box_full_error_px"] is None for row in empty)
    assert json.loads((tmp_path / "all.json").read_text())["info"]
