"""Docking quantities of a pose with its motion: closure speed, predicted miss distance, time to contact."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.estimates import Docking, PoseEstimate
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig
from nav.filtering.pose_filter import FilterState

# Straight motion predicts no longer than this; 40 m at 1.6 m/s take 25 s. [s]
_LONGEST_PREDICTION_S = 60.0
_PLACE, _TURN, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)


def capture_radius_m(drogue: DrogueParameters) -> float:
    """Largest distance from the axis at which a probe's tip enters the opening without touching the rim. [m]

    The radius of the opening less that of the probe's nozzle, which is as wide as the hub's inner edge, the coupling's
    mouth; on a drogue without a hub, as the coupling.
    """
    nozzle_m = drogue.coupling_radius_m if drogue.hub is None else drogue.hub.inner_radius_m
    return drogue.opening_radius_m - nozzle_m


def docking_quantities(
    state: FilterState | PoseEstimate,
    rig: StereoRig,
    drogue: DrogueParameters,
    capture_m: float | None = None,
) -> Docking | None:
    """Position, closure, miss distance and time of contact of the drogue relative to the probe's tip.

    The prediction is a straight line: velocity and attitude stay constant, since the attitude swings and its present
    rate does not predict it. With the rim's centre t, the axis n, the velocity v and the tip p in the left
    camera, contact is after `T = n.(t - p) / -(n.v)`, and the miss is the length of `t + T v - p`, which lies in the
    rim plane. Standard deviations are of first order, and those of the straight line: they do not include the motion
    that hose and air add until contact.

    Args:
        state: of a filter, or an estimate; without a known motion it gives the position only.
        rig: with the probe's tip.
        drogue: its capture radius and dimensions.
        capture_m: capture radius; None for `capture_radius_m` of the drogue. [m]

    Returns:
        None where the estimate has no covariance.

    Raises:
        ValueError: a capture radius that is not positive.
    """
    radius_m = capture_radius_m(drogue) if capture_m is None else capture_m
    if not (np.isfinite(radius_m) and radius_m > 0):
        raise ValueError(f"capture_m: must be positive and finite, got {radius_m}")
    covariance = _covariance(state)
    if covariance is None:
        return None
    turn, pose = rig.body_from_left.rotation, state.left_from_drogue
    from_tip = rig.body_from_left.apply(pose.translation_m) - rig.probe_tip_body_m
    sd = np.sqrt(np.diag(turn @ covariance[_PLACE, _PLACE] @ turn.T))
    docking = Docking(mouth_from_tip_m=_triple(from_tip), mouth_sd_m=_triple(sd), capture_radius_m=radius_m)
    velocity = _velocity(state)
    if velocity is None:
        return docking
    docking = docking.model_copy(update={"closure_m_s": -float(rig.body_from_left.rotate(velocity)[0])})
    contact = _contact(pose, velocity, rig.body_from_left.inverse().apply(rig.probe_tip_body_m))
    if contact is None:
        return docking
    miss_m = float(np.linalg.norm(contact.miss_m))
    miss_sd_m = _length_sd(contact.miss_m, contact.jacobian @ covariance @ contact.jacobian.T)
    found = {"miss_m": miss_m, "miss_sd_m": miss_sd_m, "contact_s": contact.time_s, "captured": miss_m <= radius_m}
    return docking.model_copy(update=found)


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return x, y, z


def _covariance(state: FilterState | PoseEstimate) -> Array | None:
    """(12, 12) of pose, velocity and rate; an estimate's are taken as independent, and zero without motion."""
    if isinstance(state, FilterState):
        return state.covariance
    if state.covariance is None:
        return None
    covariance = np.zeros((12, 12))
    covariance[:6, :6] = state.covariance
    if state.motion is not None:
        covariance[6:, 6:] = state.motion.covariance
    return covariance


def _velocity(state: FilterState | PoseEstimate) -> Array | None:
    if isinstance(state, FilterState):
        return state.velocity_m_s if state.motion_known else None
    return None if state.motion is None else np.array(state.motion.velocity_m_s)


@dataclass(frozen=True, eq=False)
class _Contact:
    """Time at which the tip reaches the rim plane, and the rim's centre relative to it then.

    Attributes:
        time_s: [s]
        miss_m: (3,) in the left camera's axes. [m]
        jacobian: (3, 12) derivative of `miss_m` by pose, velocity and rate.
    """

    time_s: float
    miss_m: Array
    jacobian: Array


def _contact(left_from_drogue: RigidTransform, velocity_m_s: Array, tip_m: Array) -> _Contact | None:
    """The predicted contact with a tip at (3,) in the left camera; None unless tip and drogue approach each other."""
    axis = left_from_drogue.rotation[:, 2]
    apart = left_from_drogue.translation_m - tip_m
    ahead_m, closing_m_s = float(axis @ apart), -float(axis @ velocity_m_s)
    if ahead_m < 0 or closing_m_s <= 0 or ahead_m > _LONGEST_PREDICTION_S * closing_m_s:
        return None
    contact_s = ahead_m / closing_m_s
    miss = apart + contact_s * velocity_m_s
    # The axis turns by w x n, so the derivative of n.a by w is (n x a).
    by_error = np.zeros(12)
    by_error[_PLACE] = axis / closing_m_s
    by_error[_TURN] = np.cross(axis, miss) / closing_m_s
    by_error[_VELOCITY] = contact_s * axis / closing_m_s
    jacobian = np.outer(velocity_m_s, by_error)
    jacobian[:, _PLACE] += np.eye(3)
    jacobian[:, _VELOCITY] += contact_s * np.eye(3)
    return _Contact(contact_s, miss, jacobian)


def _length_sd(vector: Array, covariance: Array) -> float:
    """First-order standard deviation of a vector's length; the largest of any direction for a vector near zero."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length > 0 else vector
    largest = float(np.linalg.eigvalsh(covariance)[-1])
    variance = largest if length**2 <= largest else float(along @ covariance @ along)
    return float(np.sqrt(max(variance, 0.0)))
