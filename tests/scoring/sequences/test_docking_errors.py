"""The true place at which the probe's tip reaches the rim, and the errors of its estimates."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

from datasets_manifest.types.estimates import Docking, Motion, PoseEstimate
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.pose_benchmark import sequence_data
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.results.sequence_result import Captures
from droguekit.scoring.sequences.docking_errors import (
    Arrival,
    actual_arrivals,
    calibration,
    docking_errors,
    predicted_arrival,
    tip_in_left_m,
    true_dockings,
)
from droguekit.scoring.sequences.filter_errors import SequenceData
from droguekit.scoring.sequences.sequence_truth import TrueSequence, true_sequences, true_state
from geometry.se3 import RigidTransform
from nav.docking import capture_radius_m, docking_quantities

TIP_LEFT_M = np.array([0.45, 0.35, 1.0])
"""Of the paper's rig: 1 m forward, 0.45 right, 0.35 down."""


def test_the_tip_stands_where_the_rig_has_it(build: SimpleNamespace) -> None:
    np.testing.assert_allclose(tip_in_left_m(build.rig), TIP_LEFT_M, atol=1e-12)


def test_the_arrival_is_where_the_rim_plane_meets_the_tip(build: SimpleNamespace, rng: np.random.Generator) -> None:
    for _ in range(20):
        pose = build.pose(*rng.uniform(-0.3, 0.6, 2), rng.uniform(2, 9), *rng.uniform(-15, 15, 2))
        velocity = np.array([*rng.uniform(-0.1, 0.1, 2), -rng.uniform(0.5, 1.5)])

        def ahead(time_s: float, pose: RigidTransform = pose, velocity: np.ndarray = velocity) -> float:
            return float(pose.rotation[:, 2] @ (pose.translation_m + time_s * velocity - TIP_LEFT_M))

        contact_s = brentq(ahead, 0, 60, xtol=1e-12)
        moved = pose.translation_m + contact_s * velocity
        in_drogue = pose.rotation.T @ (TIP_LEFT_M - moved)
        found = predicted_arrival(pose, velocity, TIP_LEFT_M)
        assert found is not None
        # Rounding, and the root's tolerance.
        assert found.contact_s == pytest.approx(contact_s, abs=1e-9)
        assert found.miss_m == pytest.approx(np.hypot(in_drogue[0], in_drogue[1]), abs=1e-9)


def test_nothing_arrives_that_goes_away_stands_or_is_past(build: SimpleNamespace) -> None:
    before, past = build.pose(0.45, 0.35, 4), build.pose(0.45, 0.35, 0.9)
    assert predicted_arrival(before, np.array([0, 0, 0.5]), TIP_LEFT_M) is None
    assert predicted_arrival(before, np.zeros(3), TIP_LEFT_M) is None
    assert predicted_arrival(past, np.array([0, 0, -0.5]), TIP_LEFT_M) is None
    # Three metres in more than a minute are no docking.
    assert predicted_arrival(before, np.array([0, 0, -0.049]), TIP_LEFT_M) is None


def straight(build: SimpleNamespace, count: int = 60) -> tuple[list[PairRecord], tuple[TrueSequence, ...]]:
    """A drogue that comes straight to the tip, 3 cm beside it, and passes it after 1.62 s."""
    records = build.sequence(lambda t: build.pose(0.45 + 0.03, 0.35, 1.81 - 0.5 * t), count)
    return records, true_sequences([true_state(record) for record in records])


def test_what_happens_in_the_end_is_what_was_predicted_of_straight_flight(build: SimpleNamespace) -> None:
    _, (sequence,) = straight(build)
    arrivals = actual_arrivals(sequence.states)
    for k, one in enumerate(sequence.states):
        expected = predicted_arrival(one.left_from_drogue, np.array([0, 0, -0.5]), TIP_LEFT_M)
        # 1.62 s are 40.5 pairs.
        assert (expected is None) == (arrivals[k] is None) == (k > 40)
        if expected is not None and arrivals[k] is not None:
            assert arrivals[k] == Arrival(pytest.approx(0.03), pytest.approx(expected.contact_s, abs=1e-9))


def test_a_sequence_that_stops_short_has_no_end(build: SimpleNamespace) -> None:
    _, (sequence,) = straight(build, count=30)
    assert actual_arrivals(sequence.states) == [None] * 30


def data_of(records: list[PairRecord], sequences: tuple[TrueSequence, ...]) -> SequenceData:
    return sequence_data(sequences, {record.frame_index: drogue_truth(record) for record in records})


def test_answers_from_the_true_motion_err_by_what_was_put_in(build: SimpleNamespace) -> None:
    """Navigation's own docking quantities of the true poses, moved to the right by 5 mm."""
    records, sequences = straight(build)
    data = data_of(records, sequences)
    estimates = {}
    for record in records:
        index, motion = record.frame_index, data.motions.get(record.frame_index)
        told = PoseEstimate(
            frame_index=index,
            method="m",
            left_from_drogue=record.left_from_drogue,
            covariance=np.diag([1e-5] * 6),
            motion=None
            if motion is None
            else Motion(
                velocity_m_s=tuple(motion.velocity_m_s),
                rate_rad_s=tuple(motion.rate_rad_s),
                covariance=1e-6 * np.eye(6),
            ),
        )
        docking = docking_quantities(told, build.rig, record.frame.drogue)
        assert docking is not None
        forward, right, down = docking.mouth_from_tip_m
        moved = docking.model_copy(update={"mouth_from_tip_m": (forward, right + 0.005, down)})
        estimates[index] = told.model_copy(update={"docking": moved})
    result = docking_errors(data, true_dockings(sequences, data.motions), estimates)
    assert result is not None
    row = result.overall
    assert row.n == 60
    assert (row.mouth_bias_m.forward, row.mouth_bias_m.right) == (pytest.approx(0, abs=1e-12), pytest.approx(0.005))
    assert (row.mouth_rms_m, row.mouth_rmse_m.right) == (pytest.approx(0.005), pytest.approx(0.005))
    assert row.closure_n == 52 and row.closure_rmse_m_s == pytest.approx(0, abs=1e-9)
    assert row.miss is not None and row.miss_in_the_end is not None
    # Of 52 pairs with a true motion, those before the tip is past: 4 to 40.
    assert (row.miss.n, row.miss_in_the_end.n) == (37, 37)
    assert (row.miss.rmse_m, row.miss_in_the_end.rmse_m) == (pytest.approx(0, abs=1e-8), pytest.approx(0, abs=1e-8))
    assert row.captures is not None
    # 3 cm beside the axis is well inside the opening.
    assert (row.captures.true_yes, row.captures.false_yes, row.captures.false_no, row.captures.true_no) == (37, 0, 0, 0)
    assert row.captures_in_the_end == row.captures
    # Errors of 5 mm against 3.2 mm that were reported.
    right_sd = row.calibration["right"]
    assert right_sd is not None and (right_sd.within_1, right_sd.within_2) == (0, 1)
    assert sum(place.n for place in result.bins) == 60


def test_wrong_captures_are_told_apart(build: SimpleNamespace) -> None:
    records, sequences = straight(build)
    data = data_of(records, sequences)
    estimates = {}
    for k, record in enumerate(records[:40]):
        docking = Docking(
            mouth_from_tip_m=(1, 0, 0), mouth_sd_m=(0, 0, 0), miss_m=0.01 if k < 10 else 0.4, captured=k < 10
        )
        told = PoseEstimate(frame_index=k, method="m", left_from_drogue=record.left_from_drogue, docking=docking)
        estimates[k] = told
    result = docking_errors(data, true_dockings(sequences, data.motions), estimates)
    assert result is not None and result.overall.captures is not None and result.overall.miss is not None
    found = result.overall.captures
    # The true miss, 3 cm, is a capture; pairs 4 to 39 have a true motion.
    assert (found.true_yes, found.false_yes, found.false_no, found.true_no) == (6, 0, 30, 0)
    assert found.radius_m == pytest.approx(capture_radius_m(records[0].frame.drogue))
    # Of the 60 pairs that could have been answered, 40 were.
    assert (result.overall.n, result.overall.of) == (40, 60)
    assert sum(place.of for place in result.bins) <= 60
    assert result.overall.calibration == {"forward": None, "right": None, "down": None}
    assert result.overall.miss.calibration is None
    assert result.overall.miss.median_absolute_m == pytest.approx(0.37)


def captures_of(build: SimpleNamespace, told: Callable[[int], dict[str, object]]) -> Captures:
    """Of 128 pairs that come to 3 cm beside the axis, of which 4 at either end have no true motion."""
    records = build.sequence(lambda t: build.pose(0.45 + 0.03, 0.35, 8.01 - 0.5 * t), 128)
    sequences = true_sequences([true_state(record) for record in records])
    data = data_of(records, sequences)
    estimates = {
        k: PoseEstimate(
            frame_index=k,
            method="m",
            left_from_drogue=record.left_from_drogue,
            docking=Docking(mouth_from_tip_m=(1, 0, 0), mouth_sd_m=(0, 0, 0), **told(k)),
        )
        for k, record in enumerate(records)
    }
    result = docking_errors(data, true_dockings(sequences, data.motions), estimates)
    assert result is not None and result.overall.captures is not None
    return result.overall.captures


def test_one_wrong_flag_among_many_is_counted(build: SimpleNamespace) -> None:
    """A capture that is told with a miss of 30 m, or with one of 3 cm that is none at 2 cm."""
    radius_m = 0.02
    found = captures_of(build, lambda k: {"miss_m": 30.0, "captured": k == 50, "capture_radius_m": radius_m})
    assert (found.true_yes, found.false_yes, found.false_no, found.true_no) == (0, 1, 0, 119)
    assert found.radius_m == radius_m
    # Without the field the drogue's own radius counts, which takes 3 cm in.
    found = captures_of(build, lambda k: {"miss_m": 30.0, "captured": k == 50})
    assert (found.true_yes, found.false_yes, found.false_no, found.true_no) == (1, 0, 119, 0)


def test_each_answer_is_judged_by_its_own_radius(build: SimpleNamespace) -> None:
    found = captures_of(
        build, lambda k: {"miss_m": 0.03, "captured": k % 2 == 0, "capture_radius_m": 0.04 if k % 2 == 0 else 0.02}
    )
    assert (found.true_yes, found.false_yes, found.false_no, found.true_no) == (60, 0, 0, 60)
    assert found.radius_m is None


def test_navigation_tells_the_radius_it_was_asked_for(build: SimpleNamespace) -> None:
    record = build.sequence(build.swinging, 2)[0]
    told = PoseEstimate(
        frame_index=0, method="m", left_from_drogue=record.left_from_drogue, covariance=np.diag([1e-5] * 6)
    )
    drogue = record.frame.drogue
    for asked_m, radius_m in ((0.3, 0.3), (None, capture_radius_m(drogue))):
        docking = docking_quantities(told, build.rig, drogue, asked_m)
        assert docking is not None and docking.capture_radius_m == radius_m


def test_normal_errors_are_within_as_often_as_they_should(rng: np.random.Generator) -> None:
    deviations = rng.uniform(0.5, 3, 20_000)
    found = calibration(rng.normal(0, deviations), deviations)
    assert found is not None and found.n == 20_000
    # Three standard errors of such a share are 0.01 and 0.0045.
    assert found.within_1 == pytest.approx(0.6827, abs=0.01)
    assert found.within_2 == pytest.approx(0.9545, abs=0.0045)


def test_methods_without_docking_have_none(build: SimpleNamespace) -> None:
    records, sequences = straight(build)
    data = data_of(records, sequences)
    plain = {0: PoseEstimate(frame_index=0, method="m", left_from_drogue=records[0].left_from_drogue)}
    assert docking_errors(data, true_dockings(sequences, data.motions), plain) is None
