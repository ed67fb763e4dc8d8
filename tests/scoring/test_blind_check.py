"""Estimates on a dataset without true poses: what counts, and what is told where nothing can be counted."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.storage.blind import read_blind_index
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.types.estimates import Estimate, Feature, write_estimates
from droguekit.scoring.blind_check import check_blind, write_blind_report
from geometry.se3 import RigidTransform

POSE = (0.1, -0.05, 4.0, 5.0, -3.0, 2.0)


def write_index(folder: Path, **changes: object) -> None:
    """Describe a dataset without its truth."""
    (folder / "blind.json").write_text(read_blind_index(folder).model_copy(update=changes).model_dump_json())


@pytest.fixture
def blind(build: SimpleNamespace, tmp_path: Path) -> Path:
    """Two pairs of a drogue at one place, with the box around its rim in all four images."""
    records = [build.record(index, build.pose(*POSE)) for index in range(2)]
    folder = build.dataset(tmp_path / "blind", records, alike=True)
    write_index(folder)
    boxes = [
        # COCO counts from the image's corner.
        {"image_id": 2 * k + view + 1, "bbox": np.add(each.box_full_xywh_px, (0.5, 0.5, 0, 0)).tolist()}
        for k, record in enumerate(records)
        for view, each in enumerate((record.views.left, record.views.right))
    ]
    (folder / "annotations").mkdir(exist_ok=True)
    (folder / "annotations" / "all.json").write_text(json.dumps({"annotations": boxes}))
    return folder


def written(folder: Path, *estimates: Estimate) -> Path:
    file = folder.parent / "estimates.jsonl"
    write_estimates(file, estimates)
    return file


@pytest.mark.parametrize(
    "wrong", [(0.0, 0.0, -3.0), (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 0.02), (1e8, 0.0, 1e-300)]
)
def test_a_pose_that_is_not_in_front_of_the_cameras_is_in_no_box(
    build: SimpleNamespace, blind: Path, wrong: tuple[float, float, float]
) -> None:
    features = build.features(build.record(0, build.pose(*POSE)), lambda: (0.1, 0.1))
    right = build.estimate(0, build.pose(*POSE), features=features)
    # Near the cameras, a tilt brings a part of the rim behind them.
    poses = build.pose(*wrong), build.pose(*wrong, 30.0, 0.0, 0.0)
    for turned in poses[wrong[2] > 0 :]:
        behind = build.estimate(1, turned, features=features)
        file = written(blind, right, behind)
        check = check_blind(blind, file)
        row = check.methods["joint"]
        assert (row.fixes, row.boxes, row.middle_in_box_fraction) == (2, 4, 0.5)
        # The pose in front has all of the residuals: 0.1 px in each coordinate, and rounding.
        assert row.residual_rms_px == pytest.approx(0.1, abs=1e-9)
        # Between an overlap of nearly 1 and one of 0.
        assert row.rim_box_iou_median == pytest.approx(0.5, abs=0.1)
        page = blind.parent / "page.html"
        write_blind_report(blind, file, check, page)
        assert "Frame 1, pose not in front of the cameras" in page.read_text()


@pytest.mark.parametrize("index", [9, 8, -1])
def test_a_marker_that_the_drogue_lacks_is_named(build: SimpleNamespace, blind: Path, index: int) -> None:
    feature = Feature(eye="left", index=index, center_px=(1, 1), cov_px2=((1, 0), (0, 1)), used=True)
    file = written(blind, build.estimate(0, build.pose(*POSE), features=(feature,)))
    wanted = rf"estimates\.jsonl: method 'joint': frame 0: features: index must be 'hub' or in \[0, 8\), got {index}"
    with pytest.raises(ValueError, match=wanted):
        check_blind(blind, file)


def test_a_hub_that_the_drogue_lacks_is_named(build: SimpleNamespace, blind: Path) -> None:
    write_index(blind, drogue=build.drogue())
    feature = Feature(eye="left", index="hub", center_px=(1, 1), cov_px2=((1, 0), (0, 1)), used=True)
    file = written(blind, build.estimate(0, build.pose(*POSE), features=(feature,)))
    with pytest.raises(ValueError, match="frame 0: features: the drogue has no hub"):
        check_blind(blind, file)


def test_a_dataset_whose_pairs_are_all_damaged_is_named(build: SimpleNamespace, blind: Path) -> None:
    write_index(blind, drogues_differ=True)
    for frame in (0, 1):
        (blind / "frames" / f"{frame:06d}" / "record.json").write_text("{")
    file = written(blind, build.estimate(0, build.pose(*POSE)))
    with pytest.raises(ValueError, match=r"blind: no pair can be read.*2 pairs.*000000.record\.json"):
        check_blind(blind, file, PairFaults())


def test_poses_are_left_as_they_are(build: SimpleNamespace, blind: Path) -> None:
    turned = RigidTransform(build.pose(*POSE).rotation, np.array([0.1, -0.05, 4.0]))
    row = check_blind(blind, written(blind, build.estimate(0, turned))).methods["joint"]
    assert (row.n, row.fixes, row.boxes, row.residual_rms_px) == (2, 1, 2, None)
    assert row.middle_in_box_fraction == 1.0
