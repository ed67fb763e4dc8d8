"""True velocity and rate of motions with a closed form, and the consistency of their covariances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from datasets_manifest.recipe.recipe import Recipe, load_recipe
from datasets_manifest.types.estimates import Motion, PoseEstimate
from droguekit.scoring.pose_benchmark import sequence_data
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.poses.pose_errors import normalized_squares
from droguekit.scoring.sequences.filter_errors import filter_errors
from droguekit.scoring.sequences.sequence_truth import (
    MOTION_PARTS,
    TrueSequence,
    TrueState,
    motion_errors,
    pairs_per_knot,
    smoothing_spline,
    true_motions,
    true_sequences,
    true_state,
)
from geometry.se3 import RigidTransform
from scenes.flight.sequence import sequence_kinematics

PERIOD_S = 1 / 25
MARGIN = 4
"""Pairs at either end of a run at 25 Hz without a true motion."""


def sequence_of(build: SimpleNamespace, pose_at: Callable[[float], RigidTransform], count: int = 100) -> TrueSequence:
    (sequence,) = true_sequences([true_state(record) for record in build.sequence(pose_at, count)])
    return sequence


def test_velocity_of_a_swing_is_its_derivative(build: SimpleNamespace) -> None:
    turn_s = 2 * np.pi * 0.5
    sequence = sequence_of(build, lambda t: build.pose(0.2 * np.sin(turn_s * t), 0.0, 6 - 0.6 * t))
    motions = true_motions([sequence])
    times = np.array([sequence.states[k].time_s for k in motions])
    velocity = np.array([motion.velocity_m_s for motion in motions.values()])
    expected = np.column_stack([0.2 * turn_s * np.cos(turn_s * times), 0 * times, 0 * times - 0.6])
    # A cubic spline's derivative errs by about h^3 x''''/24 for knots h = 0.16 s apart: 3 mm/s of 628.
    np.testing.assert_allclose(velocity, expected, atol=3e-3)
    # The record's own twists say the same where nothing shakes.
    assert max(np.abs(motion.vibration_m_s).max() for motion in motions.values()) < 3e-3


def test_rates_are_in_the_cameras_axes_and_may_turn_round(build: SimpleNamespace) -> None:
    axis, rate = np.array([0.6, 0.0, 0.8]), 4.0
    start = build.pose(0, 0, 5, 5, -8, 20)

    def pose_at(time_s: float) -> RigidTransform:
        turn = Rotation.from_rotvec(rate * time_s * axis).as_matrix()
        return RigidTransform(turn @ start.rotation, start.translation_m)

    motions = true_motions([sequence_of(build, pose_at)])
    # Rounding: a constant rate is a spline.
    for motion in motions.values():
        np.testing.assert_allclose(motion.rate_rad_s, rate * axis, atol=1e-6)


def test_rates_of_a_nod_belong_to_their_pair(build: SimpleNamespace) -> None:
    """Half a pair later they would be 34 mrad/s off."""
    turn_s, size = 2 * np.pi * 0.5, np.deg2rad(10)

    def pose_at(time_s: float) -> RigidTransform:
        nod = Rotation.from_rotvec([size * np.sin(turn_s * time_s), 0, 0]).as_matrix()
        return RigidTransform(nod, np.array([0, 0, 5.0]))

    sequence = sequence_of(build, pose_at)
    motions = true_motions([sequence])
    times = np.array([sequence.states[k].time_s for k in motions])
    rates = np.array([motion.rate_rad_s for motion in motions.values()])
    expected = np.column_stack([size * turn_s * np.cos(turn_s * times), 0 * times, 0 * times])
    # Means from pair to pair are less by (0.04 turn_s)^2/24 of 548 mrad/s, which is 0.4; the spline errs by less.
    np.testing.assert_allclose(rates, expected, atol=1e-3)


def test_the_instants_velocity_is_the_derivative_of_the_frame(build: SimpleNamespace) -> None:
    record = build.sequence(build.swinging, 3)[1]
    frame = record.frame.model_copy(update={"left_twist_per_s": np.array([0.3, -0.2, 0.5, 0.02, -0.03, 0.01])})
    step_s = 1e-5
    ends = [frame.left_from_drogue_at(sign * step_s).translation_m for sign in (1, -1)]
    found = true_state(record.model_copy(update={"frame": frame}))
    assert found is not None and found.instant_velocity_m_s is not None
    # Central differences err by their rounding, 1e-15 / 1e-5.
    np.testing.assert_allclose(found.instant_velocity_m_s, (ends[0] - ends[1]) / (2 * step_s), atol=1e-8)


def test_shaking_averages_out(build: SimpleNamespace, rng: np.random.Generator) -> None:
    shake = rng.normal(0, 1.4e-3, (110, 3))

    def pose_at(time_s: float) -> RigidTransform:
        smooth = build.pose(0.1, 0.0, 8 - 0.6 * time_s)
        return RigidTransform(smooth.rotation, smooth.translation_m + shake[round(time_s / PERIOD_S)])

    motions = true_motions([sequence_of(build, pose_at)])
    errors = np.array([motion.velocity_m_s - (0, 0, -0.6) for motion in motions.values()])
    central = (shake[2:] - shake[:-2]) / (2 * PERIOD_S)
    # Knots every fourth pair leave about half of what differences of neighbours do.
    assert np.sqrt((errors**2).mean()) < 0.7 * np.sqrt((central**2).mean())


@pytest.mark.slow
def test_the_motion_is_that_of_the_simulation_without_its_vibration() -> None:
    """The simulator knows both: the poses that the cameras see, and how all would move if nothing shook."""
    recipe = load_recipe("docking-10m").recipe
    assert recipe.sequence is not None and recipe.sequence.receiver is not None
    receiver = recipe.sequence.receiver.model_copy(update={"vibration_deg": 0.0, "vibration_m": 0.0})
    calm = recipe.model_copy(update={"sequence": recipe.sequence.model_copy(update={"receiver": receiver})})
    shaken, still = ([moment_of(one, k) for k in range(225)] for one in (recipe, calm))
    motions = true_motions([TrueSequence(0, PERIOD_S, tuple(shaken))])
    errors = np.array([motions[k].velocity_m_s - still[k].instant_velocity_m_s for k in motions])
    instant = np.array([shaken[k].instant_velocity_m_s - still[k].instant_velocity_m_s for k in motions])
    # Measured over both runs of this recipe: 2 to 9 mm/s; the instant's velocity has hundreds of them besides.
    assert np.sqrt((errors**2).mean(axis=0)).max() < 0.012
    assert np.sqrt((instant**2).mean(axis=0)[:2]).min() > 0.15


def moment_of(recipe: Recipe, place: int) -> TrueState:
    one = sequence_kinematics(recipe, recipe.sequence, recipe.drogue, place)
    pose, drogue, camera = one.left_from_drogue, one.drogue_twist_per_s, one.left_twist_per_s
    velocity = pose.rotate(drogue[:3]) - camera[:3] - np.cross(camera[3:], pose.translation_m)
    return TrueState(place, 0, one.time_s, recipe.rig, recipe.drogue, pose, velocity, {})


def test_ends_gaps_and_short_runs_have_no_motion(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 60)
    del records[30:33]
    (sequence,) = true_sequences([true_state(record) for record in records])
    runs = [(0, 30), (33, 60)]
    known = [k for low, high in runs for k in range(low + MARGIN, high - MARGIN)]
    assert list(true_motions([sequence])) == known
    assert true_motions([sequence_of(build, build.swinging, 2 * MARGIN)]) == {}
    assert list(true_motions([sequence_of(build, build.swinging, 2 * MARGIN + 1)])) == [MARGIN]


def swing_at(build: SimpleNamespace, rate_hz: float, count: int) -> tuple[TrueSequence, Callable[[float], float]]:
    """A swing of 0.5 Hz seen at another rate, and its velocity along X."""
    turn_s = 2 * np.pi * 0.5
    states = []
    for k in range(count):
        record = build.record(k, build.pose(0.2 * np.sin(turn_s * k / rate_hz), 0.0, 6.0))
        states.append(true_state(record.model_copy(update={"time_s": k / rate_hz, "sequence_id": 0})))
    (sequence,) = true_sequences(states)
    return sequence, lambda time_s: 0.2 * turn_s * np.cos(turn_s * time_s)


@pytest.mark.parametrize(("rate_hz", "margin"), [(20.0, 3), (25.0, 4), (50.0, 8), (100.0, 16)])
def test_knots_are_as_far_apart_in_time_at_every_rate(build: SimpleNamespace, rate_hz: float, margin: int) -> None:
    sequence, velocity_at = swing_at(build, rate_hz, round(3 * rate_hz))
    assert pairs_per_knot(sequence.period_s) == margin
    motions = true_motions([sequence])
    assert list(motions) == list(range(margin, len(sequence.states) - margin))
    errors = [motion.velocity_m_s[0] - velocity_at(k / rate_hz) for k, motion in motions.items()]
    # As at 25 Hz: 3 mm/s for knots 0.16 s apart.
    assert np.abs(errors).max() < 3e-3


def test_vibration_averages_out_better_at_twice_the_rate(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """With knots every fourth pair at any rate, three times as much of it would be left."""
    left = {}
    for rate_hz in (25.0, 50.0):
        sequence, velocity_at = swing_at(build, rate_hz, round(8 * rate_hz))
        shaken = tuple(
            replace(one, left_from_drogue=RigidTransform(pose.rotation, pose.translation_m + rng.normal(0, 2e-3, 3)))
            for one in sequence.states
            if (pose := one.left_from_drogue) is not None
        )
        motions = true_motions([replace(sequence, states=shaken)])
        errors = [motion.velocity_m_s[0] - velocity_at(k / rate_hz) for k, motion in motions.items()]
        left[rate_hz] = np.sqrt(np.mean(np.square(errors)))
    # Twice the pairs to a knot leave 0.71 of it; 50 knots know each of the two to a tenth.
    assert left[50.0] < left[25.0]


def test_pairs_at_10_hz_show_no_true_motion(build: SimpleNamespace) -> None:
    """Splines with one or two pairs to a knot follow vibration."""
    for rate_hz in (19.0, 10.0, 1.0):
        assert true_motions([swing_at(build, rate_hz, 40)[0]]) == {}


@pytest.mark.parametrize("count", [4, 5, 6, 9, 30])
@pytest.mark.parametrize("period_s", [0.01, 0.04, 0.1, 0.11, 1.0, 30.0])
def test_a_spline_has_no_more_numbers_than_values(count: int, period_s: float) -> None:
    times_s = period_s * np.arange(count)
    cubic = np.polynomial.Polynomial([0.3, -1.0, 0.5, 0.2])(times_s / times_s[-1])
    spline = smoothing_spline(times_s, cubic, period_s)
    # A cubic is a spline of any knots: rounding.
    np.testing.assert_allclose(spline(times_s), cubic, atol=1e-9)
    assert len(spline.c) <= count


def test_values_at_uneven_times_determine_the_spline(rng: np.random.Generator) -> None:
    """Steps within the rule of gaps may leave a piece without a value of its own."""
    for _ in range(500):
        steps_s = 0.17 * rng.uniform(0.05, 1.49, rng.integers(9, 60))
        times_s = np.concatenate([[0.0], np.cumsum(steps_s)])
        cubic = np.polynomial.Polynomial([0.3, -1.0, 0.5, 0.2])(times_s / times_s[-1])
        spline = smoothing_spline(times_s, cubic, float(np.percentile(steps_s, 50, method="lower")), 0.16)
        # A cubic is a spline of any knots: rounding.
        np.testing.assert_allclose(spline(times_s), cubic, atol=1e-9)


def test_the_period_is_one_of_the_steps(build: SimpleNamespace) -> None:
    """Of three pairs the middle of two steps is no step, where one is a gap."""
    records = build.sequence(build.swinging, 3)
    late = records[2].model_copy(update={"time_s": records[1].time_s + 10})
    (sequence,) = true_sequences([true_state(record) for record in (*records[:2], late)])
    assert sequence.period_s == pytest.approx(PERIOD_S)
    assert [len(run) for run in sequence.runs()] == [2, 1]


def test_squares_are_those_of_the_normal_law(rng: np.random.Generator) -> None:
    root = rng.normal(0, 1, (6, 6))
    covariance = root @ root.T
    error = rng.normal(0, 1, 6)
    law = multivariate_normal(np.zeros(6), covariance)
    expected = 2 * (law.logpdf(np.zeros(6)) - law.logpdf(error))
    squares = normalized_squares(error, covariance, MOTION_PARTS)
    assert squares is not None
    # Rounding of covariances with a condition of some thousands.
    assert squares[2] == pytest.approx(expected, rel=1e-6)
    part = multivariate_normal(np.zeros(3), covariance[3:, 3:])
    assert squares[1] == pytest.approx(2 * (part.logpdf(np.zeros(3)) - part.logpdf(error[3:])), rel=1e-6)
    assert normalized_squares(error, np.zeros((6, 6)), MOTION_PARTS) is None
    assert normalized_squares(error, -covariance, MOTION_PARTS) is None


def test_a_filter_that_tells_the_truth_of_itself(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """Errors drawn from the reported covariance: RMS, NEES and ratio to the raw method are what went in."""
    records = [r for s in range(3) for r in build.sequence(build.swinging, 100, sequence_id=s)]
    drogues = {record.frame_index: drogue_truth(record) for record in records}
    data = sequence_data(true_sequences([true_state(record) for record in records]), drogues)
    deviations = np.array([0.02, 0.02, 0.05, 0.01, 0.01, 0.01])
    root = np.linalg.cholesky(0.5 * np.diag(deviations**2) + 0.5 * np.outer(deviations, deviations))
    methods: dict[str, dict[int, PoseEstimate]] = {"joint": {}, "joint+filter": {}}
    for record in records:
        index, pose, motion = record.frame_index, record.left_from_drogue, data.motions.get(record.frame_index)
        for name, offset_m in (("joint", 0.02), ("joint+filter", 0.005)):
            moved = RigidTransform(pose.rotation, pose.translation_m + np.array([offset_m, 0, 0]))
            methods[name][index] = PoseEstimate(frame_index=index, method=name, left_from_drogue=moved)
        if motion is not None:
            told = np.concatenate([motion.velocity_m_s, motion.rate_rad_s]) + root @ rng.normal(0, 1, 6)
            reported = Motion(velocity_m_s=tuple(told[:3]), rate_rad_s=tuple(told[3:]), covariance=root @ root.T)
            assert motion_errors(reported, motion) == pytest.approx(told - [*motion.velocity_m_s, *motion.rate_rad_s])
            estimate = methods["joint+filter"][index]
            methods["joint+filter"][index] = estimate.model_copy(update={"motion": reported})
    result = filter_errors(data, "joint+filter", methods)
    assert filter_errors(data, "joint", methods) is None
    assert result is not None and result.motion is not None and result.nees is not None and result.raw is not None
    count = 3 * (100 - 2 * MARGIN)
    # Four standard errors of a root mean square of that many.
    spread = 4 / np.sqrt(2 * count)
    rows = result.motion
    assert (rows.n, rows.of) == (count, count)
    assert rows.velocity_rmse_m_s.z == pytest.approx(0.05, rel=spread)
    assert rows.rate_rmse_deg_s.x == pytest.approx(np.rad2deg(0.01), rel=spread)
    assert rows.speed_interval is not None and rows.speed_interval[0] < rows.speed_rmse_m_s < rows.speed_interval[1]
    assert sum(row.n for row in result.bins) == count
    assert result.nees.motion is not None and result.nees.interval is not None
    assert result.nees.motion.freedom == 6
    # Four standard errors of the mean of chi-square over its freedom.
    assert result.nees.motion.per_freedom == pytest.approx(1, abs=4 * np.sqrt(2 / (6 * count)))
    assert (result.raw.against, result.raw.overall.n) == ("joint", 300)
    assert result.raw.overall.position == pytest.approx(0.25)


def test_two_pairs_of_one_time_are_an_error(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 3)
    same = records[2].model_copy(update={"time_s": records[1].time_s})
    with pytest.raises(ValueError, match="frame 1: time_s: must differ from that of the next pair of sequence 0"):
        true_sequences([true_state(record) for record in (*records[:2], same)])
