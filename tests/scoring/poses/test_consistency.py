from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.types.estimates import PoseEstimate
from droguekit.scoring.confidence_intervals import mean_square_region, rms_upper_limit
from droguekit.scoring.poses.cramer_rao import component_covariance
from droguekit.scoring.poses.pose_errors import (
    PoseError,
    estimates_by_method,
    nees,
    normalized_errors,
    pose_error,
    squared_errors,
)
from geometry.se3 import RigidTransform, exp_twist


@pytest.fixture
def covariance(rng: np.random.Generator) -> np.ndarray:
    """Millimetres and milliradians, all correlated."""
    root = rng.normal(0, 1e-3, (6, 6))
    return root @ root.T


def estimate_of(pose: RigidTransform, covariance: np.ndarray | None, **more: object) -> PoseEstimate:
    return PoseEstimate(frame_index=0, method="m", left_from_drogue=pose, covariance=covariance, **more)


def moved(pose: RigidTransform, twist: np.ndarray) -> RigidTransform:
    return RigidTransform(exp_twist(np.r_[0, 0, 0, twist[3:]]).rotation @ pose.rotation, pose.translation_m + twist[:3])


def test_errors_of_the_reported_covariance_have_nees_one(
    build: SimpleNamespace, covariance: np.ndarray, rng: np.random.Generator
) -> None:
    truth, count = build.pose(0.3, -0.2, 6, 5, -8, 3), 3000
    squares = []
    for twist in rng.multivariate_normal(np.zeros(6), covariance, count):
        estimate = estimate_of(moved(truth, twist), covariance)
        squares.append(squared_errors(estimate, pose_error(estimate.left_from_drogue, truth)))
    row = nees(squares)
    assert (row.n, row.unusable) == (count, 0)
    for part, freedom in ((row.position, 3), (row.attitude, 2), (row.pose, 5)):
        assert part.freedom == freedom
        # Standard error of the mean of chi-square over its freedom; four of those.
        assert part.per_freedom == pytest.approx(1, abs=4 * np.sqrt(2 / (freedom * count)))
        assert part.low < 1 < part.high


def test_twice_the_covariance_halves_the_nees(build: SimpleNamespace, covariance: np.ndarray) -> None:
    pose, error = build.pose(0, 0, 5, 3, 4), PoseError(np.array([1e-3, 2e-3, -1e-3, 0.05, 0.1]), 0.0)
    once, twice = (squared_errors(estimate_of(pose, k * covariance), error) for k in (1, 2))
    np.testing.assert_allclose(once, 2 * twice, rtol=1e-9)


def test_roll_does_not_count(build: SimpleNamespace, covariance: np.ndarray) -> None:
    """Neither an error of roll nor a covariance that knows nothing of it."""
    truth = build.pose(0.3, -0.2, 6, 5, -8, 3)
    axis = truth.rotation[:, 2]
    loose = covariance.copy()
    loose[3:, 3:] += 100 * np.outer(axis, axis)
    # Only rounding of the large part that cancels.
    np.testing.assert_allclose(
        component_covariance(truth, loose), component_covariance(truth, covariance), atol=1e-9 * covariance.max()
    )
    rolled = moved(truth, np.r_[0, 0, 0, 0.4 * axis])
    squares = squared_errors(estimate_of(rolled, covariance), pose_error(rolled, truth))
    assert squares.max() < 1e-9


def test_covariances_that_say_nothing_are_counted(build: SimpleNamespace, covariance: np.ndarray) -> None:
    pose, error = build.pose(0, 0, 5), PoseError(np.full(5, 1e-3), 0.0)
    indefinite = np.diag([1.0, 1, 1, 1, 1, 1])
    indefinite[0, 1] = indefinite[1, 0] = 2.0
    cases = [
        estimate_of(pose, np.zeros((6, 6))),
        estimate_of(pose, -covariance),
        estimate_of(pose, indefinite),
        estimate_of(pose, covariance, tangent="right"),
    ]
    squares = [squared_errors(case, error) for case in cases]
    assert squares == [None] * 4
    row = nees(squares)
    assert (row.n, row.unusable, row.pose) == (0, 4, None)
    assert nees([]) is None


@pytest.mark.parametrize("size", [1e-320, 5e-324, 1e-200, 1e305, 1.7e308])
def test_covariances_that_no_float_can_work_with_are_unusable(build: SimpleNamespace, size: float) -> None:
    """Their squares are infinite, and a JSON file has no place for that."""
    error = PoseError(np.full(5, 1e-3), 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        squares = squared_errors(estimate_of(build.pose(0, 0, 5, 3, 4), size * np.eye(6)), error)
        row = nees([squares] * 3)
    assert row is not None
    if size < 1:
        assert (row.n, row.unusable) == (0, 3)
    else:
        # Too large ones say truly that nothing is known, as long as they are numbers.
        assert row.pose is None or row.pose.per_freedom == pytest.approx(0)


def test_normalized_errors_are_over_the_bound_of_their_own_frame() -> None:
    bounds = [np.array([1e-3, 1e-3, 1e-2, 0.1, 0.2]) * k for k in (1.0, 10.0, 100.0)]
    pairs = [(PoseError(bound * [1, -2, 3, 0, 0.5], 0.0), bound) for bound in bounds]
    row = normalized_errors(pairs)
    # Rounding.
    assert [row.nrms.x, row.nrms.y, row.nrms.z, row.nrms.pitch, row.nrms.yaw] == pytest.approx([1, 2, 3, 0, 0.5])
    assert row.upper.y == pytest.approx(rms_upper_limit(2.0, 3))
    assert normalized_errors([]) is None


def test_upper_limit_of_known_cases(rng: np.random.Generator) -> None:
    # chi-square quantile at 0.05 of 10 degrees of freedom: 3.9403.
    assert rms_upper_limit(1.0, 10) == pytest.approx(np.sqrt(10 / 3.9403), rel=1e-5)
    samples = rng.normal(0, 1, (4000, 20))
    limits = np.array([rms_upper_limit(rms, 20) for rms in np.sqrt((samples**2).mean(axis=1))])
    # The true value 1 lies below the limit in 95 %; three standard errors of 4000 trials are 1 %.
    assert (limits > 1).mean() == pytest.approx(0.95, abs=0.0104)


def test_region_of_true_means_is_the_chi_square_law() -> None:
    # Quantiles 0.025 and 0.975 of 30 degrees of freedom: 16.791 and 46.979.
    assert mean_square_region(30) == pytest.approx((16.791 / 30, 46.979 / 30), rel=1e-4)


def test_an_asymmetric_covariance_is_unusable(build: SimpleNamespace, covariance: np.ndarray) -> None:
    pose, error = build.pose(0, 0, 5), PoseError(np.full(5, 1e-3), 0.0)
    # As printed with few digits, or in floats of 32 bits.
    assert squared_errors(estimate_of(pose, covariance.astype(np.float32).astype(np.float64)), error) is not None
    lower = np.tril(covariance)
    lower[3, 0] += 0.5 * np.sqrt(covariance[3, 3] * covariance[0, 0])
    assert squared_errors(estimate_of(pose, lower), error) is None


def test_files_of_too_many_methods_are_refused(build: SimpleNamespace) -> None:
    estimates = [estimate_of(build.pose(0, 0, 5), None).model_copy(update={"method": f"m{k}"}) for k in range(101)]
    assert len(estimates_by_method(estimates[:100], [0], "mine.jsonl")) == 100
    with pytest.raises(ValueError, match=r"^mine\.jsonl: holds more than 100 methods; split it"):
        estimates_by_method(estimates, [0], "mine.jsonl")
