"""The filter with late, missing, ambiguous and wrong fixes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_manifest.types.estimates import Mode, NoFix, PoseEstimate
from geometry.se3 import RigidTransform
from nav.filtering.measurement_update import PoseMeasurement, measurement_from_estimate, pose_difference
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import FilterState, PoseFilter

Measure = Callable[..., PoseEstimate]
PERIOD_S = 0.04
ORDER = 8
SETTINGS = FilterSettings()


def _pose(time_s: float, tilt_rad: float = 0.1) -> RigidTransform:
    """An approach at 0.8 m/s with a slow roll."""
    attitude = Rotation.from_euler("YXZ", [tilt_rad, 0.05, 0.2 * time_s]).as_matrix()
    return RigidTransform(attitude, np.array([0.1, -0.2 + 0.1 * time_s, 8.0 - 0.8 * time_s]))


def _flown(measure: Measure, covariance: np.ndarray, pairs: int = 40) -> PoseFilter:
    fixes = PoseFilter(SETTINGS, ORDER)
    for index in range(pairs):
        fixes.update(index * PERIOD_S, measure(_pose(index * PERIOD_S), covariance))
    return fixes


def _same(one: FilterState | None, other: FilterState | None, atol: float = 0.0) -> bool:
    assert one is not None and other is not None
    away = pose_difference(one.left_from_drogue, other.left_from_drogue)
    return bool(np.abs(away).max() <= atol and np.allclose(one.covariance, other.covariance, rtol=1e-12, atol=atol))


def test_there_is_no_state_before_the_first_fix_and_after_coasting(measure: Measure, covariance: np.ndarray) -> None:
    fixes = PoseFilter(SETTINGS, ORDER)
    assert fixes.predict(0.0) is None
    first = fixes.update(3.0, measure(_pose(0), covariance))
    assert first.accepted and first.nis is None and first.reason == "first fix"
    assert fixes.predict(3.0 + SETTINGS.max_coast_s) is not None
    assert fixes.predict(3.0 + SETTINGS.max_coast_s + 1e-3) is None
    assert fixes.predict(2.9) is None
    again = fixes.update(60.0, measure(_pose(2), covariance))
    assert again.accepted and "after a gap of 57 s" in again.reason
    fixes.reset()
    assert fixes.predict(60.0) is None


def test_prediction_does_not_change_the_filter_and_its_covariance_grows(
    measure: Measure, covariance: np.ndarray
) -> None:
    fixes = _flown(measure, covariance)
    end_s = 39 * PERIOD_S
    before = fixes.predict(end_s)
    ahead = [fixes.predict(end_s + gap) for gap in (0.0, 0.04, 0.1, 0.3, 0.5)]
    assert _same(before, fixes.predict(end_s))
    sizes = [np.trace(state.covariance[:3, :3]) for state in ahead if state is not None]
    assert len(sizes) == 5 and (np.diff(sizes) > 0).all()
    # Exact fixes of a nearly constant motion: the way after 0.3 s within the accelerations that it does have.
    assert ahead[3] is not None
    away = pose_difference(ahead[3].left_from_drogue, _pose(end_s + 0.3))
    assert np.abs(away).max() < 0.002


def test_dropped_frames_and_uneven_times(measure: Measure, covariance: np.ndarray, rng: np.random.Generator) -> None:
    fixes = PoseFilter(SETTINGS, ORDER)
    times = np.cumsum(rng.choice([0.01, 0.04, 0.08, 0.33], 80))
    updates = [fixes.update(float(time), measure(_pose(float(time)), covariance, rng)) for time in times]
    assert all(update.accepted for update in updates)
    state = updates[-1].state
    assert state is not None
    # Half a second's gaps and noise of 10 mm along the sight.
    assert abs(state.velocity_m_s[2] + 0.8) < 4 * state.covariance[8, 8] ** 0.5 < 0.4


@pytest.mark.parametrize("late", [5, 12])
def test_a_late_fix_is_as_good_as_one_in_time(
    measure: Measure, covariance: np.ndarray, rng: np.random.Generator, late: int
) -> None:
    estimates = [measure(_pose(index * PERIOD_S), covariance, rng) for index in range(20)]
    in_time, delayed = PoseFilter(SETTINGS, ORDER), PoseFilter(SETTINGS, ORDER)
    for index, estimate in enumerate(estimates):
        update = in_time.update(index * PERIOD_S, estimate)
        if index != late:
            delayed.update(index * PERIOD_S, estimate)
        if index == late:
            at_its_time = update.state
    assert not _same(delayed.predict(0.8), in_time.predict(0.8))
    assert _same(delayed.update(late * PERIOD_S, estimates[late]).state, at_its_time)
    assert _same(delayed.predict(0.8), in_time.predict(0.8))
    too_late = in_time.update(-1.0, estimates[0])
    assert not too_late.accepted and "came too late" in too_late.reason


@pytest.mark.parametrize("age", [0, 3])
def test_a_repeated_estimate_is_refused(measure: Measure, covariance: np.ndarray, age: int) -> None:
    fixes = _flown(measure, covariance)
    before, time_s = fixes.predict(1.6), (39 - age) * PERIOD_S
    again = fixes.update(time_s, measure(_pose(time_s), covariance))
    assert not again.accepted and again.nis is None and "already" in again.reason
    assert _same(fixes.predict(1.6), before)


def test_a_clock_that_is_set_back_restarts_the_filter(measure: Measure, covariance: np.ndarray) -> None:
    fixes = _flown(measure, covariance)
    assert fixes.update(1e9, measure(_pose(0), covariance)).accepted
    answers = [
        fixes.update(index * PERIOD_S, measure(_pose(index * PERIOD_S), covariance))
        for index in range(40, 41 + SETTINGS.restart_fixes)
    ]
    refused = SETTINGS.restart_fixes - 1
    assert [answer.accepted for answer in answers] == [False] * refused + [True, True]
    assert "too late" in answers[0].reason and answers[refused].reason == "first fix"


def test_an_outlier_is_rejected_and_a_persistent_jump_accepted(measure: Measure, covariance: np.ndarray) -> None:
    fixes = _flown(measure, covariance)
    time_s = 40 * PERIOD_S
    jump = RigidTransform(np.eye(3), np.array([0.5, 0.0, 0.0]))
    expected = fixes.predict(time_s)
    outlier = fixes.update(time_s, measure(jump @ _pose(time_s), covariance))
    assert not outlier.accepted and outlier.nis is not None and outlier.nis > 100 and "gate" in outlier.reason
    assert _same(outlier.state, expected)
    assert fixes.update(time_s + 0.04, measure(_pose(time_s + 0.04), covariance)).accepted
    answers = []
    for index in range(SETTINGS.restart_fixes):
        now_s = time_s + 0.08 + index * PERIOD_S
        answers.append(fixes.update(now_s, measure(jump @ _pose(now_s), covariance)))
    assert [answer.accepted for answer in answers] == [False] * (SETTINGS.restart_fixes - 1) + [True]
    assert "agree" in answers[-1].reason and answers[-1].state is not None
    assert abs(answers[-1].state.left_from_drogue.translation_m[0] - 0.6) < 0.01


def test_outliers_that_disagree_do_not_restart_the_filter(
    measure: Measure, covariance: np.ndarray, rng: np.random.Generator
) -> None:
    fixes = _flown(measure, covariance)
    for index in range(40, 50):
        wild = RigidTransform(np.eye(3), rng.uniform(-1, 1, 3) * [2, 2, 0] + [0, 0, 3.0 * (index % 2)])
        assert not fixes.update(index * PERIOD_S, measure(wild @ _pose(index * PERIOD_S), covariance)).accepted
    assert fixes.update(50 * PERIOD_S, measure(_pose(50 * PERIOD_S), covariance)).accepted


def test_equivalent_rolls_are_one(measure: Measure, covariance: np.ndarray, rng: np.random.Generator) -> None:
    plain, turned = PoseFilter(SETTINGS, ORDER), PoseFilter(SETTINGS, ORDER)
    for index in range(40):
        pose = _pose(index * PERIOD_S)
        roll = Rotation.from_rotvec([0, 0, rng.integers(ORDER) * 2 * np.pi / ORDER if index else 0]).as_matrix()
        one = plain.update(index * PERIOD_S, measure(pose, covariance))
        other = turned.update(
            index * PERIOD_S, measure(RigidTransform(pose.rotation @ roll, pose.translation_m), covariance)
        )
        assert other.accepted
        # Rounding of a turn about the axis.
        assert _same(one.state, other.state, atol=1e-9)


def test_roll_is_continuous_beyond_one_markers_turn(measure: Measure, covariance: np.ndarray) -> None:
    fixes, rate = PoseFilter(SETTINGS, ORDER), 2.0
    for index in range(100):
        roll = rate * index * PERIOD_S % (2 * np.pi / ORDER)
        pose = RigidTransform(Rotation.from_rotvec([0, 0, roll]).as_matrix(), np.array([0.0, 0.0, 5.0]))
        update = fixes.update(index * PERIOD_S, measure(pose, covariance))
        assert update.accepted
    assert update.state is not None
    # The rate's own noise by the densities is larger; the fixes are exact.
    assert abs(update.state.rate_rad_s[2] - rate) < 0.01


def _ambiguous(time_s: float, share: float, covariance: np.ndarray) -> PoseEstimate:
    """The mixture of a tilt of 0.1 rad and its mirror image, as method `joint` reports one."""
    true, false = _pose(time_s), _pose(time_s, -0.1 + 0.4 * np.sin(3 * time_s))
    apart = pose_difference(true, false)
    mean = Rotation.from_rotvec((1 - share) * apart[3:]).as_matrix() @ true.rotation
    spread = share * (1 - share) * np.outer(apart, apart)
    modes = sorted(
        [Mode(left_from_drogue=true, weight=share), Mode(left_from_drogue=false, weight=1 - share)],
        key=lambda mode: -mode.weight,
    )
    return PoseEstimate(
        frame_index=0,
        method="drawn",
        left_from_drogue=RigidTransform(mean, true.translation_m),
        covariance=covariance + spread,
        modes=tuple(modes),
    )


def test_mode_covariances_are_recovered_from_the_mixture(covariance: np.ndarray) -> None:
    fix = measurement_from_estimate(_ambiguous(0.0, 0.4, covariance), ORDER, 1e-3)
    assert isinstance(fix, PoseMeasurement) and fix.weights == pytest.approx((0.6, 0.4))
    # Rounding of a spread that is 1000 times the covariance.
    np.testing.assert_allclose(fix.covariance, covariance, atol=1e-12)


def test_both_hypotheses_are_kept_until_one_is_refuted(covariance: np.ndarray) -> None:
    fixes = PoseFilter(SETTINGS, ORDER)
    first = fixes.update(0.0, _ambiguous(0.0, 0.45, covariance)).state
    assert first is not None and len(first.modes) == 2
    apart = pose_difference(first.modes[0].left_from_drogue, first.modes[1].left_from_drogue)
    # The told covariance reaches the other mode: it lies within two deviations.
    assert apart @ np.linalg.solve(first.covariance[:6, :6], apart) < 4
    for index in range(1, 40):
        # The images speak for the true tilt in five pairs of six, for the other in the sixth.
        share = 0.4 if index % 6 == 0 else 0.55
        state = fixes.update(index * PERIOD_S, _ambiguous(index * PERIOD_S, share, covariance)).state
    assert state is not None
    assert np.abs(pose_difference(state.left_from_drogue, _pose(39 * PERIOD_S))).max() < 0.005
    assert len(state.modes) <= SETTINGS.most_hypotheses
    sure = fixes.update(1.6, _ambiguous(1.6, 0.999999, covariance)).state
    assert sure is not None and len(sure.modes) == 1


def test_a_wrong_first_mode_is_dropped(measure: Measure, covariance: np.ndarray) -> None:
    fixes = PoseFilter(SETTINGS, ORDER)
    for index in range(10):
        fixes.update(index * PERIOD_S, _ambiguous(index * PERIOD_S, 0.47, covariance))
    state = fixes.update(0.4, measure(_pose(0.4), covariance)).state
    assert state is not None and len(state.modes) == 1
    assert np.abs(pose_difference(state.left_from_drogue, _pose(0.4))).max() < 0.005


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"covariance": None}, "no covariance"),
        ({"covariance": np.zeros((6, 6))}, "variance outside"),
        ({"covariance": np.full((6, 6), 1e300)}, "variance outside"),
        ({"covariance": np.ones((6, 6)) * 1e-4}, "not positive definite"),
        ({"covariance": np.eye(6) * 1e-4 - np.eye(6, k=1) * 1e-5}, "not symmetric"),
        ({"covariance": np.diag([1.0, 1, 1, 1, 1, -1])}, "variance outside"),
        ({"tangent": "body"}, "another tangent"),
        ({"left_from_drogue": RigidTransform(np.eye(3), np.array([0, 0, 1e200]))}, "farther than"),
    ],
)
def test_invalid_estimates_are_refused(
    measure: Measure, covariance: np.ndarray, change: dict[str, object], reason: str
) -> None:
    fixes = _flown(measure, covariance)
    before = fixes.predict(1.6)
    update = fixes.update(1.6, measure(_pose(1.6), covariance).model_copy(update=change))
    assert not update.accepted and update.nis is None and reason in update.reason
    assert _same(update.state, before) and _same(fixes.predict(1.6), before)


def test_invalid_numbers_are_errors(measure: Measure, covariance: np.ndarray) -> None:
    fixes = _flown(measure, covariance)
    for time_s in (np.nan, np.inf):
        with pytest.raises(ValueError, match="time_s: must be finite"):
            fixes.predict(time_s)
        with pytest.raises(ValueError, match="time_s: must be finite"):
            fixes.update(time_s, measure(_pose(0), covariance))
    with pytest.raises(ValueError, match="symmetry_order"):
        PoseFilter(SETTINGS, 0)
    for wrong in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="acceleration_m2_s3"):
            FilterSettings(acceleration_m2_s3=wrong)
        with pytest.raises(ValueError, match="max_coast_s"):
            FilterSettings(max_coast_s=wrong)
    with pytest.raises(ValueError, match="acceleration_m2_s3"):
        FilterSettings(acceleration_m2_s3=0)
    with pytest.raises(ValueError, match="gate_probability"):
        FilterSettings(gate_probability=1.0)
    assert fixes.predict(1e300) is None and fixes.update(1e300, measure(_pose(0), covariance)).accepted


@pytest.mark.slow
def test_covariances_stay_valid_over_ten_thousand_fixes(
    measure: Measure, covariance: np.ndarray, rng: np.random.Generator
) -> None:
    settings = FilterSettings(vibration_m=0, vibration_rad=0, max_delay_s=0)
    fixes = PoseFilter(settings, ORDER)
    scales = 10.0 ** rng.uniform(-4, 1, 10_000)
    for index, scale in enumerate(scales):
        pose = RigidTransform(Rotation.from_rotvec([0, 0, 0.001 * index]).as_matrix(), np.array([0.0, 0.0, 5.0]))
        update = fixes.update(index * 0.01, measure(pose, covariance * scale))
        assert update.accepted
        if index % 1000 == 999:
            assert update.state is not None
            spread = np.sqrt(np.diag(update.state.covariance))
            assert np.linalg.eigvalsh(update.state.covariance / np.outer(spread, spread)).min() > 0
            np.testing.assert_allclose(update.state.covariance, update.state.covariance.T)


def test_motion_is_known_from_the_second_fix_on(measure: Measure, covariance: np.ndarray) -> None:
    fixes, pose = PoseFilter(FilterSettings(max_coast_s=1.0), ORDER), RigidTransform(np.eye(3), np.array([0, 0, 5.0]))
    # The third fix is the first after a gap.
    for time_s, known in ((0.0, False), (0.04, True), (2.0, False), (2.04, True)):
        state = fixes.update(time_s, measure(pose, covariance)).state
        later = fixes.predict(time_s + 0.01)
        assert state is not None and later is not None
        assert state.motion_known is later.motion_known is known
        assert (state.to_estimate(0, "joint+filter").motion is not None) is known


def test_a_state_becomes_an_estimate(measure: Measure, covariance: np.ndarray) -> None:
    state = _flown(measure, covariance).predict(1.6)
    assert state is not None
    seen = NoFix(frame_index=40, method="joint", reason="no drogue detected", stage_s={"detect": 0.1}, latency_s=0.2)
    estimate = state.to_estimate(40, "joint+filter", seen)
    assert PoseEstimate.model_validate_json(estimate.model_dump_json()).method == "joint+filter"
    assert estimate.stage_s == {"detect": 0.1} and estimate.latency_s == 0.2
    assert estimate.motion is not None and estimate.motion.velocity_m_s == tuple(state.velocity_m_s)
    assert estimate.covariance is not None
    np.testing.assert_array_equal(estimate.covariance, state.covariance[:6, :6])
