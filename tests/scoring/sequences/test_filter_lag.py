"""The lag of estimates that are late by a known time."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.types.estimates import PoseEstimate
from droguekit.scoring.poses.pose_errors import COMPONENTS
from droguekit.scoring.sequences.filter_errors import MOST_LAG_S, lags
from droguekit.scoring.sequences.sequence_truth import TrueSequence, true_sequences, true_state
from geometry.se3 import RigidTransform

COUNT = 75


def flights(
    build: SimpleNamespace, pose_at: Callable[[float], RigidTransform], number: int
) -> tuple[TrueSequence, ...]:
    records = [record for s in range(number) for record in build.sequence(pose_at, COUNT, sequence_id=s)]
    return true_sequences([true_state(record) for record in records])


def late_estimates(
    sequences: tuple[TrueSequence, ...], pose_at: Callable[[float], RigidTransform], lag_s: Callable[[int], float]
) -> dict[int, PoseEstimate]:
    """What a drogue that moves like that was like some time before each pair."""
    estimates = {}
    for sequence in sequences:
        for one in sequence.states:
            since_s = one.time_s - sequence.states[0].time_s
            pose = pose_at(since_s - lag_s(sequence.sequence_id))
            estimates[one.frame_index] = PoseEstimate(frame_index=one.frame_index, method="late", left_from_drogue=pose)
    return estimates


@pytest.mark.parametrize("lag_s", [0.0, 0.0337, -0.0212, 0.2])
def test_the_lag_of_a_swing_is_found_between_the_pairs(build: SimpleNamespace, lag_s: float) -> None:
    sequences = flights(build, build.swinging, 1)
    found = lags(sequences, late_estimates(sequences, build.swinging, lambda _: lag_s), "test")
    assert found is not None and set(found) == set(COMPONENTS)
    for row in found.values():
        # Knots every 0.16 s follow 1.1 Hz to a thousandth of its amplitude; the least error moves by less than 1 ms.
        assert row.lag_s == pytest.approx(lag_s, abs=1e-3)
        assert row.interval is None


def test_a_constant_error_is_no_lag(build: SimpleNamespace) -> None:
    sequences = flights(build, build.swinging, 2)
    estimates = late_estimates(sequences, build.swinging, lambda _: 0.05)
    aside = {
        i: e.model_copy(
            update={
                "left_from_drogue": RigidTransform(
                    e.left_from_drogue.rotation, e.left_from_drogue.translation_m + np.array([0.02, -0.1, 0.3])
                )
            }
        )
        for i, e in estimates.items()
    }
    there, here = (lags(sequences, some, "test") for some in (aside, estimates))
    assert there is not None and here is not None
    for name in "xyz":
        # Rounding.
        assert there[name].lag_s == pytest.approx(here[name].lag_s, abs=1e-9)


def test_noise_leaves_the_lag_where_it_is(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """Only the truth is looked up between the pairs, so that noisy estimates do not look best half a pair off."""
    sequences = flights(build, build.swinging, 3)
    estimates = {
        i: e.model_copy(
            update={
                "left_from_drogue": RigidTransform(
                    e.left_from_drogue.rotation, e.left_from_drogue.translation_m + rng.normal(0, 0.02, 3)
                )
            }
        )
        for i, e in late_estimates(sequences, build.swinging, lambda _: 0.0).items()
    }
    found = lags(sequences, estimates, "test")
    assert found is not None and found["x"].lag_s is not None
    # 150 errors of 20 mm against a velocity of 490 mm/s (RMS): 3.3 ms; four of them.
    assert abs(found["x"].lag_s) < 4 * 0.02 / (0.49 * np.sqrt(150))


def test_intervals_are_of_whole_sequences(build: SimpleNamespace) -> None:
    sequences = flights(build, build.swinging, 5)
    estimates = late_estimates(sequences, build.swinging, lambda s: 0.03 + 0.01 * (s - 2))
    found = lags(sequences, estimates, "test")
    assert found is not None and found["x"].interval is not None
    low, high = found["x"].interval
    # The mean of five values 10 ms apart has a standard error of 6.3 ms.
    assert 0.015 < low < 0.024
    assert 0.036 < high < 0.045


def test_even_motion_and_large_lags_tell_nothing(build: SimpleNamespace) -> None:
    def evenly(time_s: float) -> RigidTransform:
        return build.pose(0.1, 0.0, 8 - 0.6 * time_s, 3, 2)

    sequences = flights(build, evenly, 1)
    found = lags(sequences, late_estimates(sequences, evenly, lambda _: 0.1), "test")
    assert found is not None
    assert [row.lag_s for row in found.values()] == [None] * 5
    slow = flights(build, lambda t: build.pose(0.3 * np.sin(t), 0, 6), 1)
    far = late_estimates(slow, lambda t: build.pose(0.3 * np.sin(t), 0, 6), lambda _: 1.5 * MOST_LAG_S)
    beyond = lags(slow, far, "test")
    assert beyond is not None and beyond["x"].lag_s is None


def test_short_sequences_have_no_lag(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 40)
    sequences = true_sequences([true_state(record) for record in records])
    estimates = late_estimates(sequences, build.swinging, lambda _: 0.0)
    # 40 pairs leave 15 whose truth is known half a second before and after.
    assert lags(sequences, estimates, "test") is None
