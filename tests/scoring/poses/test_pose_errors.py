from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.types.estimates import NoFix
from droguekit.scoring.poses.pose_errors import estimates_by_method, pose_error
from geometry.se3 import RigidTransform


def test_no_error_for_the_truth(build: SimpleNamespace) -> None:
    pose = build.pose(1, -2, 12, 7, -8, 20)
    error = pose_error(pose, pose)
    assert error.components.tolist() == [0] * 5
    assert error.transverse_m == 0


def test_roll_does_not_count(build: SimpleNamespace) -> None:
    error = pose_error(build.pose(0, 0, 5, 7, -8, 65), build.pose(0, 0, 5, 7, -8, 20))
    # Rounding of products of rotations.
    np.testing.assert_allclose(error.components, 0, atol=1e-12)


def test_signs_are_estimate_minus_truth(build: SimpleNamespace) -> None:
    error = pose_error(build.pose(1.1, 2.2, 10.3, 5, 1, 0), build.pose(1, 2, 10, 2, 3, 0))
    # Rounding.
    np.testing.assert_allclose(error.components, [0.1, 0.2, 0.3, 3, -2], atol=1e-12)
    assert error.position_m == pytest.approx(np.sqrt(0.14), rel=1e-12)


def test_an_error_along_the_line_of_sight_is_not_transverse(build: SimpleNamespace) -> None:
    truth = build.pose(2, -1, 10)
    along = RigidTransform(truth.rotation, truth.translation_m * 1.01)
    # Rounding of lengths of 10 m.
    assert pose_error(along, truth).transverse_m == pytest.approx(0, abs=1e-14)
    across = RigidTransform(truth.rotation, truth.translation_m + np.array([0.01, 0.02, 0.0]))
    error = pose_error(across, truth)
    assert 0 < error.transverse_m <= error.position_m


def test_angles_are_compared_the_short_way(build: SimpleNamespace) -> None:
    # An axis that looks back: yaws of 179 and -179 deg are 2 deg apart.
    error = pose_error(build.pose(0, 0, 5, 0, 179), build.pose(0, 0, 5, 0, -179))
    assert error.components[4] == pytest.approx(-2, abs=1e-9)


def test_estimates_are_sorted_by_method(build: SimpleNamespace) -> None:
    pose = build.pose(0, 0, 5)
    estimates = [
        build.estimate(2, pose, "b"),
        build.estimate(1, pose, "a"),
        NoFix(frame_index=1, method="b", reason="dark"),
    ]
    methods = estimates_by_method(estimates, [1, 2, 3], "e.jsonl")
    assert list(methods) == ["b", "a"]
    assert sorted(methods["b"]) == [1, 2]


def test_an_unknown_frame_is_named(build: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match=r"e\.jsonl: method 'joint': frame 9 is not in the dataset"):
        estimates_by_method([build.estimate(9, build.pose(0, 0, 5))], [1, 2], "e.jsonl")


def test_a_frame_given_twice_is_named(build: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match=r"e\.jsonl: method 'joint': frame 1 occurs twice"):
        estimates_by_method([build.estimate(1, build.pose(0, 0, 5))] * 2, [1, 2], "e.jsonl")


def test_no_estimates_at_all_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"e\.jsonl: holds no estimates"):
        estimates_by_method([], [1, 2], "e.jsonl")
