"""Method `joint`: the pose that best explains the markers in both eyes at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array, RigidTransform
from nav.pose.adjustment import Adjusted, adjust
from nav.pose.interface import NoFixReason, Observation, PoseMode, Solution, fault
from nav.pose.prediction import predict_px
from nav.pose.two_fold_start import two_fold_start

# Two starts that end this near each other found one minimum.
_SAME_TURN_RAD = 1e-4
# Matched markers miss their places by this share of a marker's own radius only when they are not the drogue's.
_LARGEST_MISS_FRACTION = 0.5
_LEAST_MISS_PX = 3.0


def joint(observation: Observation) -> Solution | NoFixReason:
    """Weighted least squares over all measurements, from both weak-perspective attitudes.

    The answer is the minimum with the lower cost; where the starts end apart, both are reported, with weights by
    Laplace's approximation, `exp(-cost) |information|^(-1/2)`, and no prior. The covariance is the inverse information.
    """
    reason = fault(observation)
    if reason is not None:
        return reason
    adjusted = adjust(observation, *two_fold_start(observation))
    order = _distinct(adjusted)
    best = int(order[0])
    covariance = _inverse(adjusted.information[best])
    if covariance is None or adjusted.rotations[best, 2, 2] <= 0 or adjusted.translations_m[best, 2] <= 0:
        return NoFixReason("the adjustment found no pose in front of the cameras")
    miss_px, limit_px = _miss_px(observation, adjusted, best)
    if miss_px > limit_px:
        return NoFixReason(f"the markers do not fit the drogue: they miss their places by {miss_px:.1f} px (rms)")
    modes = _modes(adjusted, order)
    return Solution(modes[0].left_from_drogue, observation.seen, covariance, modes)


def _distinct(adjusted: Adjusted) -> NDArray[np.int64]:
    """Indices of the minima found, the lowest first, each once."""
    order = np.argsort(adjusted.costs, kind="stable")
    apart = adjusted.rotations[order[0], :, 2] - adjusted.rotations[order[1], :, 2]
    return order if np.linalg.norm(apart) > _SAME_TURN_RAD else order[:1]


def _modes(adjusted: Adjusted, order: NDArray[np.int64]) -> tuple[PoseMode, ...]:
    log_weights = -adjusted.costs[order] - np.linalg.slogdet(adjusted.information[order])[1] / 2
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    return tuple(
        PoseMode(
            RigidTransform(adjusted.rotations[i], adjusted.translations_m[i]), float(adjusted.costs[i]), float(weight)
        )
        for i, weight in zip(order, weights, strict=True)
    )


def _inverse(information: Array) -> Array | None:
    """The covariance, or None when the measurements leave a direction open."""
    # Metres and radians differ in size: compare the eigenvalues of the scaled matrix.
    scale = np.sqrt(np.diag(information))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return None
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] <= np.finfo(np.float64).eps:
        return None
    covariance: Array = (vectors / values) @ vectors.T / np.outer(scale, scale)
    return covariance


def _miss_px(observation: Observation, adjusted: Adjusted, index: int) -> tuple[float, float]:
    """Root mean square residual, and the largest that is believed. [px]"""
    rotation, translation = adjusted.rotations[index], adjusted.translations_m[index]
    predicted = predict_px(observation.rig, observation.layout, rotation[None], translation[None])[0]
    residual = np.linalg.norm(predicted - observation.pixels_px, axis=-1)[observation.seen]
    radius_px = observation.rig.camera.fx_px * observation.layout.radius_m / translation[2]
    return float(np.sqrt(np.mean(residual**2))), max(_LEAST_MISS_PX, _LARGEST_MISS_FRACTION * float(radius_px))
