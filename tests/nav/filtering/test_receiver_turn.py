"""A receiver that turns by 30 degrees within 0.85 s, and back."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from geometry.se3 import RigidTransform
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import FilterUpdate, PoseFilter
from nav.filtering.smoother import smooth

Measure = Callable[..., PoseEstimate]
PERIOD_S = 0.04
BEGINS_S, LASTS_S, ANGLE_RAD = 1.0, 1.7, np.radians(30)
TIMES = [index * PERIOD_S for index in range(100)]
AFTER_ONSET = slice(27, 70)


def _turned(time_s: float) -> Rotation:
    """The camera turns aside and back, with jumps of the angular acceleration to 7 rad/s^2."""
    share = np.clip((time_s - BEGINS_S) / LASTS_S, 0, 1)
    return Rotation.from_rotvec([0.0, ANGLE_RAD * (1 - np.cos(2 * np.pi * share)) / 2, 0.0])


def _pose(time_s: float) -> RigidTransform:
    """A slow approach, as the camera sees it."""
    back = _turned(time_s).inv()
    attitude = back * Rotation.from_euler("YXZ", [0.1, 0.05, 0.1])
    return RigidTransform(attitude.as_matrix(), back.apply([0.1, -0.2, 8.0 - 0.8 * time_s]))


def _velocity(time_s: float) -> np.ndarray:
    step_s = 1e-5  # an error of the square of it
    ends = [_pose(time_s + sign * step_s).translation_m for sign in (1, -1)]
    velocity: np.ndarray = (ends[0] - ends[1]) / (2 * step_s)
    return velocity


def _answers(estimates: list[PoseEstimate], settings: FilterSettings) -> list[FilterUpdate]:
    fixes = PoseFilter(settings, 8)
    return [fixes.update(time_s, estimate) for time_s, estimate in zip(TIMES, estimates, strict=True)]


@pytest.fixture
def estimates(rng: np.random.Generator, measure: Measure, covariance: np.ndarray) -> list[PoseEstimate]:
    """Fixes of half a millimetre along the sight and less across."""
    return [measure(_pose(time_s), covariance / 400, rng, index) for index, time_s in enumerate(TIMES)]


def test_no_fix_is_rejected_in_a_turn(estimates: list[PoseEstimate]) -> None:
    answers = _answers(estimates, FilterSettings())
    assert all(answer.accepted for answer in answers)
    states = [answer.state for answer in answers if answer.state is not None]
    assert len(states) == len(TIMES)
    # Explanations that differ in when the turn began are no different poses.
    assert all(len(state.modes) == 1 for state in states)
    away = np.array([state.velocity_m_s - _velocity(time_s) for state, time_s in zip(states, TIMES, strict=True)])
    # Velocity lags by 0.29 periods of an acceleration of 52 m/s^2 at most, 37 m/s^2 in the mean square: 0.43 m/s.
    assert np.sqrt((away[AFTER_ONSET] ** 2).sum(axis=1).mean()) < 0.5
    squares = [
        each @ np.linalg.solve(state.covariance[6:9, 6:9], each) / 3
        for each, state in zip(away[AFTER_ONSET], states[AFTER_ONSET], strict=True)
    ]
    assert np.mean(squares) < 2
    # It is known again as before once the turn is over.
    assert np.abs(away[-10:]).max() < 0.05 and states[-1].covariance[6, 6] < 2 * states[20].covariance[6, 6]


def test_without_turns_in_the_model_fixes_are_rejected(estimates: list[PoseEstimate]) -> None:
    answers = _answers(estimates, FilterSettings(turns_per_s=0))
    assert sum(not answer.accepted for answer in answers) > 5


@pytest.mark.parametrize("offset_m", [[0.5, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 1.0]])
@pytest.mark.parametrize("wrong", [20, 35, 45])
def test_outliers_are_not_taken_for_turns(
    estimates: list[PoseEstimate], wrong: int, offset_m: list[float], covariance: np.ndarray, measure: Measure
) -> None:
    jump = RigidTransform(np.eye(3), np.array(offset_m))
    estimates[wrong] = measure(jump @ _pose(TIMES[wrong]), covariance / 400, None, wrong)
    answers = _answers(estimates, FilterSettings())
    assert [index for index, answer in enumerate(answers) if not answer.accepted] == [wrong]


def test_the_smoother_follows_a_turn(estimates: list[PoseEstimate]) -> None:
    smoothed: list[Estimate] = smooth(TIMES, estimates, FilterSettings(), 8)
    for estimate, time_s in zip(smoothed, TIMES, strict=True):
        assert isinstance(estimate, PoseEstimate)
        # A tenth of a millimetre across the sight, half of one along it; five deviations.
        assert np.abs(estimate.left_from_drogue.translation_m - _pose(time_s).translation_m).max() < 2.5e-3


def test_the_filter_restarts_in_the_middle_of_a_turn(estimates: list[PoseEstimate]) -> None:
    fixes = PoseFilter(FilterSettings(), 8)
    answers = [fixes.update(TIMES[index], estimates[index]) for index in (*range(20), *range(55, 80))]
    assert "gap" in answers[20].reason and all(answer.accepted for answer in answers)
    second = answers[21].state
    assert second is not None
    # Two fixes 0.04 s apart tell it but for half a period of an acceleration of 52 m/s^2.
    assert np.linalg.norm(second.velocity_m_s - _velocity(TIMES[56])) < 1.1
