from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from droguekit.scoring.poses.centroid_errors import centroid_errors
from droguekit.scoring.poses.cramer_rao import FacingRing, flip_probability
from droguekit.scoring.poses.drogue_truth import DrogueTruth, drogue_truth
from droguekit.scoring.poses.pose_errors import FlipTrial, flip_statistics, flip_trials, ring_tilt_scale
from geometry.se3 import RigidTransform

MIDDLE_M = 0.06


def truth_of(build: SimpleNamespace, *pose: float, **drogue: object) -> DrogueTruth:
    return drogue_truth(build.record(0, build.pose(*pose), build.drogue(**drogue)))


def covariance_deg(tilt_deg: float) -> np.ndarray:
    """The same uncertainty of attitude about every axis."""
    return np.diag([1e-6] * 3 + [np.deg2rad(tilt_deg) ** 2] * 3)


def mirrored(truth: DrogueTruth) -> RigidTransform:
    """The pose with its axis mirrored in the line of sight of the point between the eyes."""
    pose = truth.left_from_drogue
    sight = pose.translation_m - [MIDDLE_M, 0, 0]
    sight = sight / np.linalg.norm(sight)
    turn = 2 * np.outer(sight, sight) - np.eye(3)
    axis = turn @ pose.rotation[:, 2]
    side = np.cross([0, 1, 0], axis)
    side = side / np.linalg.norm(side)
    return RigidTransform(np.column_stack([side, np.cross(axis, side), axis]), pose.translation_m)


def test_a_mirrored_tilt_is_a_flip_and_the_true_one_is_not(build: SimpleNamespace) -> None:
    truth = truth_of(build, MIDDLE_M, 0, 20, 6, -4, 3)
    right = flip_trials(truth.left_from_drogue, truth, covariance_deg(0.5), None)
    wrong = flip_trials(mirrored(truth), truth, covariance_deg(0.5), None)
    assert right.optical == right.sight == FlipTrial(False, None)
    assert wrong.optical == wrong.sight == FlipTrial(True, None)


def test_off_the_axis_the_mirror_lies_across_the_line_of_sight(build: SimpleNamespace) -> None:
    """Seen 11 deg to the right, a yaw of 6 deg turns by 5 deg against the sight; its mirror image is at 16 deg."""
    truth = truth_of(build, MIDDLE_M + 4, 0, 20, 0, 6, 0)
    trials = flip_trials(mirrored(truth), truth, covariance_deg(0.5), None)
    assert trials.optical == FlipTrial(False, None)
    assert trials.sight == FlipTrial(True, None)


@pytest.mark.parametrize(("deviation_deg", "counts"), [(1.19, True), (1.21, False)])
def test_only_a_clear_tilt_counts(build: SimpleNamespace, deviation_deg: float, counts: bool) -> None:
    truth = truth_of(build, MIDDLE_M, 0, 20, 6, 0, 0)
    trial = flip_trials(truth.left_from_drogue, truth, covariance_deg(deviation_deg), None).optical
    assert (trial is not None) is counts


def test_a_drogue_that_faces_us_has_no_tilt_to_mirror(build: SimpleNamespace) -> None:
    truth = truth_of(build, MIDDLE_M, 0, 20)
    assert flip_trials(truth.left_from_drogue, truth, covariance_deg(0.5), None).optical is None


def test_the_law_is_that_of_the_markers_used(build: SimpleNamespace) -> None:
    truth = truth_of(build, MIDDLE_M, 0, 20, 6, 0, 0)
    features = build.features(build.record(0, truth.left_from_drogue, build.drogue()), lambda: (0.0, 0.0))
    seven = tuple(f.model_copy(update={"used": f.index != 3}) for f in features)
    camera = build.rig.camera
    for measured, count in ((features, 8), (seven, 7)):
        scale = ring_tilt_scale(truth, centroid_errors(truth, measured), 0.1)
        assert scale == pytest.approx(0.1 * FacingRing(camera.fx_px, 0.12, 0.27, count, 20).tilt_rad, rel=1e-9)
        trial = flip_trials(truth.left_from_drogue, truth, covariance_deg(0.5), scale).sight
        # Rounding of the tilt.
        assert trial.predicted == pytest.approx(flip_probability(np.deg2rad(6), scale), rel=1e-6)


def test_off_the_axis_the_law_takes_the_distance_along_the_line_of_sight(build: SimpleNamespace) -> None:
    truth = truth_of(build, MIDDLE_M + 5, 2, 20, 6, 0, 0)
    features = build.features(build.record(0, truth.left_from_drogue, build.drogue()), lambda: (0.0, 0.0))
    away_m = float(np.linalg.norm([5.0, 2.0, 20.0]))
    expected = 0.1 * FacingRing(build.rig.camera.fx_px, 0.12, 0.27, 8, away_m).tilt_rad
    assert ring_tilt_scale(truth, centroid_errors(truth, features), 0.1) == pytest.approx(expected, rel=1e-9)


def test_the_law_says_nothing_of_a_hub_or_one_eye(build: SimpleNamespace) -> None:
    truth = drogue_truth(build.record(0, build.pose(MIDDLE_M, 0, 20, 6)))
    features = build.features(build.record(0, truth.left_from_drogue), lambda: (0.0, 0.0))
    assert any(feature.index == "hub" for feature in features)
    one_eye = tuple(f for f in features if f.eye == "left" and f.index != "hub")
    for measured in (features, one_eye, ()):
        assert ring_tilt_scale(truth, centroid_errors(truth, measured), 0.1) is None


def test_rows_count_flips() -> None:
    row = flip_statistics([FlipTrial(True, 0.3), FlipTrial(False, 0.1), FlipTrial(False, 0.2)])
    assert (row.n, row.flips, row.rate) == (3, 1, 1 / 3)
    assert row.predicted == pytest.approx(0.2)
    assert row.interval[0] < 1 / 3 < row.interval[1]
    assert flip_statistics([FlipTrial(True, None), FlipTrial(False, 0.1)]).predicted is None
    assert flip_statistics([]).model_dump() == {"n": 0, "flips": 0, "rate": None, "interval": None, "predicted": None}
