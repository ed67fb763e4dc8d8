"""Docking quantities against closed forms and drawn motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_manifest.types.estimates import PoseEstimate
from drogue_models.presets import load_drogue
from geometry.pinhole import PinholeCamera
from geometry.se3 import FRD_FROM_OPTICAL, RigidTransform
from geometry.stereo import StereoRig
from nav.docking import capture_radius_m, docking_quantities
from nav.filtering.pose_filter import FilterState

TIP_M = np.array([1.0, 0.45, 0.35])
RIG = StereoRig(PinholeCamera(1280, 960, 1000.0, 1000.0, 639.5, 479.5), 0.3, probe_tip_body_m=TIP_M)
DROGUE = load_drogue("red-8")
TIP_LEFT_M = FRD_FROM_OPTICAL.inverse().apply(TIP_M)


def _ahead_of_tip(offset: list[float]) -> np.ndarray:
    """A place in the left camera's axes, from the probe's tip. [m]"""
    place: np.ndarray = TIP_LEFT_M + np.array(offset)
    return place


def _state(
    place: np.ndarray, velocity: np.ndarray, tilt: np.ndarray | None = None, spread: np.ndarray | None = None
) -> FilterState:
    turn = np.eye(3) if tilt is None else Rotation.from_rotvec(tilt).as_matrix()
    covariance = np.eye(12) * 1e-8 if spread is None else spread
    return FilterState(0.0, RigidTransform(turn, place), velocity, np.array([0.3, 0.2, 0.1]), covariance)


def _spread(scale: float) -> np.ndarray:
    root = np.random.default_rng(3).normal(size=(12, 12)) * np.repeat([1.0, 1.0, 0.3, 1.0], 3)[:, None]
    matrix: np.ndarray = root @ root.T * scale**2
    return matrix


def test_straight_ahead() -> None:
    docking = docking_quantities(_state(_ahead_of_tip([0.03, -0.04, 3.0]), np.array([0, 0, -0.6])), RIG, DROGUE)
    assert docking is not None
    # Forward is the camera's z, right its x, down its y.
    np.testing.assert_allclose(docking.mouth_from_tip_m, [3.0, 0.03, -0.04], atol=1e-12)
    np.testing.assert_allclose(docking.mouth_sd_m, [1e-4] * 3)
    assert docking.closure_m_s == pytest.approx(0.6) and docking.contact_s == pytest.approx(5.0)
    assert docking.miss_m == pytest.approx(0.05) and docking.captured is True
    # (dx, dy) + 5 s times (dvx, dvy): variance 1 + 25.
    assert docking.miss_sd_m == pytest.approx(1e-4 * 26**0.5)


def test_it_is_told_in_the_axes_of_the_body() -> None:
    turn = Rotation.from_euler("xyz", [0.3, -0.2, 0.4]).as_matrix()
    body_from_left = RigidTransform(turn @ FRD_FROM_OPTICAL.rotation, np.array([0.5, 0.2, -0.1]))
    rig = StereoRig(RIG.camera, 0.3, body_from_left, TIP_M)
    place, velocity = np.array([0.4, 0.1, 6.0]), np.array([0.1, 0.0, -0.7])
    docking = docking_quantities(_state(place, velocity, spread=_spread(0.01)), rig, DROGUE)
    assert docking is not None
    np.testing.assert_allclose(docking.mouth_from_tip_m, body_from_left.apply(place) - TIP_M, atol=1e-12)
    assert docking.closure_m_s == pytest.approx(-(body_from_left.rotation @ velocity)[0])
    variances = np.diag(body_from_left.rotation @ _spread(0.01)[:3, :3] @ body_from_left.rotation.T)
    np.testing.assert_allclose(docking.mouth_sd_m, np.sqrt(variances))


def test_the_miss_is_where_the_tip_pierces_the_rim_plane() -> None:
    place, velocity = _ahead_of_tip([0.4, 0.1, 4.0]), np.array([-0.05, 0.02, -0.8])
    state = _state(place, velocity, np.array([0.2, -0.3, 0.5]))
    docking = docking_quantities(state, RIG, DROGUE, 0.3)
    assert docking is not None and docking.contact_s is not None and docking.miss_m is not None
    then = RigidTransform(state.left_from_drogue.rotation, place + docking.contact_s * velocity)
    tip_in_drogue = then.inverse().apply(TIP_LEFT_M)
    assert abs(tip_in_drogue[2]) < 1e-12
    assert docking.miss_m == pytest.approx(float(np.hypot(*tip_in_drogue[:2])))
    assert docking.captured is (docking.miss_m <= 0.3)


def test_its_deviation_is_that_of_drawn_motions() -> None:
    place, velocity = _ahead_of_tip([0.6, -0.3, 2.0]), np.array([0.4, 0.3, -0.8])
    tilt, spread = np.array([0.15, -0.1, 0.0]), _spread(0.003)
    docking = docking_quantities(_state(place, velocity, tilt, spread), RIG, DROGUE)
    assert docking is not None and docking.miss_sd_m is not None
    draws = np.random.default_rng(5).multivariate_normal(np.zeros(12), spread, 4000)
    turn = Rotation.from_rotvec(tilt)
    axes = (Rotation.from_rotvec(draws[:, 3:6]) * turn).as_matrix()[:, :, 2]
    apart, moves = place + draws[:, :3] - TIP_LEFT_M, velocity + draws[:, 6:9]
    after_s = (axes * apart).sum(axis=1) / -(axes * moves).sum(axis=1)
    misses = np.linalg.norm(apart + after_s[:, None] * moves, axis=1)
    # A deviation of 4000 draws is known within 1.1 %; the second order adds about as much.
    assert misses.std() == pytest.approx(docking.miss_sd_m, rel=0.05)


def test_where_nothing_misses_the_deviation_is_the_largest() -> None:
    docking = docking_quantities(_state(_ahead_of_tip([0, 0, 2.0]), np.array([0, 0, -1.0])), RIG, DROGUE)
    assert docking is not None and docking.miss_m == 0
    assert docking.miss_sd_m == pytest.approx(1e-4 * 5**0.5)


@pytest.mark.parametrize(
    ("ahead_m", "speed_m_s"),
    [(3.0, 0.5), (3.0, 0.0), (-0.1, -0.5), (3.0, -1e-300), (3.0, -0.04)],
    ids=["opens", "stands", "is past", "hardly closes", "closes in 75 s"],
)
def test_no_contact_unless_they_close(ahead_m: float, speed_m_s: float) -> None:
    docking = docking_quantities(_state(_ahead_of_tip([0, 0, ahead_m]), np.array([0, 0, speed_m_s])), RIG, DROGUE)
    assert docking is not None and docking.closure_m_s == pytest.approx(-speed_m_s)
    assert docking.contact_s is docking.miss_m is docking.miss_sd_m is docking.captured is None


def test_an_estimate_tells_what_it_knows() -> None:
    state = _state(_ahead_of_tip([0.1, 0.0, 3.0]), np.array([0, 0, -0.6]))
    estimate = state.to_estimate(0, "joint+filter")
    assert docking_quantities(estimate, RIG, DROGUE) == docking_quantities(state, RIG, DROGUE)
    still = docking_quantities(estimate.model_copy(update={"motion": None}), RIG, DROGUE)
    assert still is not None and still.closure_m_s is None and still.miss_m is None
    bare = PoseEstimate(frame_index=0, method="paper", left_from_drogue=estimate.left_from_drogue)
    assert docking_quantities(bare, RIG, DROGUE) is None


def test_a_motion_that_is_not_known_leads_to_no_contact() -> None:
    state = replace(_state(_ahead_of_tip([0.1, 0.0, 3.0]), np.array([0, 0, -0.6])), motion_known=False)
    docking = docking_quantities(state, RIG, DROGUE)
    assert docking is not None and docking.mouth_from_tip_m == pytest.approx((3.0, 0.1, 0.0))
    assert docking.closure_m_s is docking.contact_s is docking.miss_m is docking.captured is None


def test_capture_radius() -> None:
    # Opening of 0.21 m less the coupling's mouth of 0.05 m.
    assert capture_radius_m(DROGUE) == pytest.approx(0.16)
    assert capture_radius_m(DROGUE.model_copy(update={"hub": None})) == pytest.approx(0.125)
    state = _state(_ahead_of_tip([0.17, 0.0, 3.0]), np.array([0, 0, -0.6]))
    answers = [docking_quantities(state, RIG, DROGUE, radius) for radius in (None, 0.2)]
    assert [answer.captured for answer in answers if answer is not None] == [False, True]
    for radius in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="capture_m"):
            docking_quantities(state, RIG, DROGUE, radius)
