"""Joint adjustment of many frames at once, with both tilts that a flat pattern far away allows.

Each frame is adjusted from two starts, tilted one way and the other. Where the ring alone does not tell which tilt is
right, the reported pose is the posterior's mean over both, with the covariance of the mixture. Elsewhere it is the
minimum with the lower cost, with the inverse information as covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from geometry.stereo import StereoRig
from nav.pose.adjustment import SQUARED_LOSS, AdjustedPoses, Loss, adjust, information_at, inverse_information
from nav.pose.features import Features, stack_features
from nav.pose.pose_method import EXACT, StatedTolerances

# Keeps the fit of markers on a line solvable; no share of any that are not.
_RIDGE_FRACTION = 1e-12


def two_fold_starts(features: Features) -> tuple[Array, Array]:
    """Both weak-perspective poses of the ring's markers that every eye measured.

    The affine map from the rim plane to the image, averaged over the eyes, is scale times the first two columns of the
    attitude without their third components, whose common sign it leaves open.

    Args:
        features: B frames with at least three markers that all eyes measured, not on a line.

    Returns:
        rotations (B, 2, 3, 3) `left_from_drogue`, translations (B, 2, 3). [m]
    """
    camera = features.camera
    linear_px, center_px = _affine(features)
    # Rays with z = 1: the affine map in units of the focal length.
    linear = linear_px / np.array([camera.fx_px, camera.fy_px])[:, None]
    direction = camera.rays(center_px)
    scale = _largest_stretches(linear)
    # Markers in one point have no scale; any will do, the adjustment's cost then tells.
    scale = np.maximum(scale, np.finfo(np.float64).tiny ** 0.5)
    translation = direction / scale[:, None]
    translation[:, 0] += features.eye_x_m.mean()

    both = np.empty((len(scale), 2, 3, 2))
    both[:, :, :2] = (linear / scale[:, None, None])[:, None]
    flat = both[:, 0, :2]
    third = np.sqrt(np.maximum(0.0, 1 - (flat**2).sum(axis=1)))
    third[:, 1] = -np.copysign(third[:, 1], flat[:, 0, 0] * flat[:, 0, 1] + flat[:, 1, 0] * flat[:, 1, 1])
    both[:, 0, 2], both[:, 1, 2] = third, -third
    rotations = line_of_sight_rotations(direction)[:, None] @ _orthonormal(both)
    return rotations, np.repeat(translation[:, None], 2, axis=1)


def line_of_sight_rotations(directions: Array) -> Array:
    """(B, 3, 3) smallest rotations that carry the optical axis onto (B, 3) directions with positive z."""
    sight = directions / np.sqrt((directions**2).sum(axis=1, keepdims=True))
    x, y, z = sight.T
    rotations = np.empty((len(sight), 3, 3))
    rotations[:, :, 2] = sight
    rotations[:, 2, 0], rotations[:, 2, 1] = -x, -y
    rotations[:, 0, 0], rotations[:, 1, 1] = 1 - x * x / (1 + z), 1 - y * y / (1 + z)
    rotations[:, 0, 1] = rotations[:, 1, 0] = -x * y / (1 + z)
    return rotations


def _affine(features: Features) -> tuple[Array, Array]:
    """(B, 2, 2) linear parts and (B, 2) images of the drogue's origin, of the maps from rim plane to mean image."""
    paired = (features.seen.all(axis=1) & features.is_marker).astype(np.float64)
    cyclopean = features.measured[:2].mean(axis=2).transpose(1, 2, 0)
    total = np.maximum(paired.sum(axis=1), 1)[:, None]
    places = features.points_m[:, :2]
    mean_place = paired @ places / total
    mean_px = (paired[..., None] * cyclopean).sum(axis=1) / total
    centred = (places - mean_place[:, None]) * paired[..., None]
    normal = centred.transpose(0, 2, 1) @ centred
    ridge = _RIDGE_FRACTION * (normal[:, 0, 0] + normal[:, 1, 1]) + np.finfo(np.float64).tiny
    normal += ridge[:, None, None] * np.eye(2)
    moments = centred.transpose(0, 2, 1) @ (cyclopean - mean_px[:, None])
    linear = np.linalg.solve(normal, moments).transpose(0, 2, 1)
    return linear, mean_px - (linear @ mean_place[..., None])[..., 0]


def _orthonormal(columns: Array) -> Array:
    """(..., 3, 3) rotations whose first two columns are nearest to two nearly orthonormal ones (..., 3, 2)."""
    rotations = np.empty((*columns.shape[:-1], 3))
    u, _, vt = np.linalg.svd(columns, full_matrices=False)
    np.matmul(u, vt, out=rotations[..., :2])
    rotations[..., 2] = cross(rotations[..., 0], rotations[..., 1])
    return rotations


def cross(first: Array, second: Array) -> Array:
    """(..., 3) cross products; numpy's function takes several times as long for a few."""
    ax, ay, az, bx, by, bz = (vectors[..., axis] for vectors in (first, second) for axis in range(3))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _largest_stretches(linear: Array) -> Array:
    """(B,) largest singular values of (B, 2, 2) maps."""
    (a, b), (c, d) = linear.transpose(1, 2, 0)
    stretches: Array = (np.hypot(a + d, b - c) + np.hypot(a - d, b + c)) / 2
    return stretches


# Standard deviation of pitch and of yaw, of drogues that swing within 10 degrees uniformly: 5.8 degrees.
TILT_PRIOR_RAD = np.radians(6.0)
# The sign of a tilt is told when the tilt exceeds this many of its deviations at the frontal pose: wrong in 0.1 %.
_RELIABLE_SIGMAS = 3.0
# Two starts that end this near each other found one minimum.
_SAME_TURN_RAD = 1e-4


@dataclass(frozen=True, eq=False)
class JointBatch:
    """Poses of B frames.

    Attributes:
        rotations: (B, 3, 3) `left_from_drogue`.
        translations_m: (B, 3).
        covariances: (B, 6, 6) in the tangent of `datasets_manifest.types.estimates`.
        sound: (B,) whether there is a pose in front of the cameras that the measurements determine; nothing else of a
            frame means anything where not.
        tilt_sign_reliable: (B,) whether the tilt is large enough for its sign to be told.
        mode_rotations: (B, 2, 3, 3) the poses that both starts led to, the best first.
        mode_translations_m: (B, 2, 3).
        mode_costs: (B, 2) half the sum of squared residuals in standard deviations, priors included.
        mode_weights: (B, 2) shares of the posterior; the second is 0 where both starts led to one pose.
    """

    rotations: Array
    translations_m: Array
    covariances: Array
    sound: NDArray[np.bool_]
    tilt_sign_reliable: NDArray[np.bool_]
    mode_rotations: Array
    mode_translations_m: Array
    mode_costs: Array
    mode_weights: Array


def solve_joint_batch(
    rig: StereoRig, layout: MarkerLayout, pixels_px: Array, cov_px2: Array, tolerances: StatedTolerances = EXACT
) -> JointBatch:
    """Methods `joint` and, with the hub's edges among the pixels, `joint-hub`, for many frames of one drogue.

    Args:
        rig: the stereo rig.
        layout: the drogue's markers and hub.
        pixels_px: (B, E, F, 2) measured ellipse centres, nan where there is none; E = 1 (left eye) or 2, F = N markers,
            or N + 2 with the hub's inner and outer edge.
        cov_px2: (B, E, F, 2, 2) their covariances, or what broadcasts to it.
        tolerances: of drogue and rig.

    Raises:
        ValueError: an array of another shape.
    """
    return solve_features(stack_features(rig, layout, pixels_px, cov_px2, tolerances))


def solve_features(features: Features) -> JointBatch:
    """As `solve_joint_batch`, from stacked features."""
    frames = np.arange(features.frames)
    found = _TiltPairs.of(adjust_both_tilts(features, *two_fold_starts(features)))
    order = np.argsort(found.costs, axis=1, kind="stable")
    found = found.ordered(order)
    best_rotation, best_translation = found.rotations[:, 0], found.translations_m[:, 0]
    covariance, sound = inverse_information(found.information[:, 0])
    sound &= np.isfinite(found.costs[:, 0]) & (best_rotation[:, 2, 2] > 0) & (best_translation[:, 2] > 0)
    weights = _mode_weights(found, TILT_PRIOR_RAD)
    reliable = _tilt_sign_reliable(features, best_rotation, best_translation) | ~sound

    rotations, translations = best_rotation.copy(), best_translation.copy()
    doubtful = frames[~reliable]
    if len(doubtful):
        prior = Loss(tilt_prior_rad=TILT_PRIOR_RAD)
        starts = (found.rotations[doubtful], found.translations_m[doubtful])
        drawn = _TiltPairs.of(adjust_both_tilts(features.take(doubtful), *starts, prior))
        shares = _mode_weights(drawn, np.inf)
        order = np.argsort(-shares, axis=1, kind="stable")
        drawn, shares = drawn.ordered(order), np.take_along_axis(shares, order, axis=1)
        mean = _mixture_mean(drawn, shares)
        rotations[doubtful], translations[doubtful], covariance[doubtful] = mean
        found.replace(doubtful, drawn)
        weights[doubtful] = shares
    return JointBatch(
        rotations,
        translations,
        covariance,
        sound,
        reliable & sound,
        found.rotations,
        found.translations_m,
        found.costs,
        weights,
    )


def adjust_both_tilts(
    features: Features, rotations: Array, translations_m: Array, loss: Loss = SQUARED_LOSS
) -> AdjustedPoses:
    """Adjust (B, 2) starts; the results lie frame by frame, two after each other."""
    twice = features.take(np.repeat(np.arange(features.frames), 2))
    return adjust(twice, rotations.reshape(-1, 3, 3), translations_m.reshape(-1, 3), loss)


@dataclass(frozen=True, eq=False)
class _TiltPairs:
    """What both starts of B frames led to, (B, 2, ...)."""

    rotations: Array
    translations_m: Array
    costs: Array
    information: Array

    @staticmethod
    def of(adjusted: AdjustedPoses) -> _TiltPairs:
        size = adjusted.information.shape[-1]
        return _TiltPairs(
            adjusted.rotations.reshape(-1, 2, 3, 3),
            adjusted.translations_m.reshape(-1, 2, 3),
            adjusted.costs.reshape(-1, 2),
            adjusted.information.reshape(-1, 2, size, size),
        )

    def ordered(self, order: NDArray[np.int64]) -> _TiltPairs:
        rows = np.arange(len(order))[:, None]
        return _TiltPairs(*(values[rows, order] for values in vars(self).values()))

    def replace(self, frames: NDArray[np.int64], other: _TiltPairs) -> None:
        for mine, theirs in zip(vars(self).values(), vars(other).values(), strict=True):
            mine[frames] = theirs


def _mode_weights(pairs: _TiltPairs, prior_rad: float) -> Array:
    """(B, 2) shares of the posterior by Laplace's approximation, `exp(-cost) |information|^(-1/2)` times a tilt prior.

    A pose behind the cameras has no share, and neither has the second of two equal poses.
    """
    axes = pairs.rotations[..., 2]
    with np.errstate(invalid="ignore"):
        log_weights = -pairs.costs - np.linalg.slogdet(pairs.information)[1] / 2
    log_weights -= (axes[..., :2] ** 2).sum(axis=-1) / (2 * prior_rad**2)
    possible = np.isfinite(log_weights) & (axes[..., 2] > 0) & (pairs.translations_m[..., 2] > 0)
    possible[:, 1] &= np.linalg.norm(axes[:, 0] - axes[:, 1], axis=-1) > _SAME_TURN_RAD
    # Whoever has only impossible poses keeps the first; it is not sound.
    possible[:, 0] |= ~possible.any(axis=1)
    log_weights = np.where(possible, np.where(np.isfinite(log_weights), log_weights, 0.0), -np.inf)
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    shares: Array = weights / weights.sum(axis=1, keepdims=True)
    return shares


def _tilt_sign_reliable(features: Features, rotations: Array, translations_m: Array) -> NDArray[np.bool_]:
    """(B,) whether the tilt against the line of sight exceeds three deviations that it would have at zero."""
    middle = np.array([features.eye_x_m.mean(), 0.0, 0.0])
    frontal = line_of_sight_rotations(translations_m - middle)
    covariance, determined = inverse_information(information_at(features, frontal, translations_m))
    variance = (covariance[:, 3, 3] + covariance[:, 4, 4]) / 2
    # 1 - cos loses small tilts to rounding; the cross product does not.
    tilt = np.sqrt((cross(rotations[:, :, 2], frontal[:, :, 2]) ** 2).sum(axis=1))
    reliable: NDArray[np.bool_] = determined & (tilt > _RELIABLE_SIGMAS * np.sqrt(variance))
    return reliable


def _mixture_mean(pairs: _TiltPairs, weights: Array) -> tuple[Array, Array, Array]:
    """Mean rotations (B, 3, 3), translations (B, 3) and covariances (B, 6, 6) of two weighted Gaussians each."""
    count, size = len(weights), pairs.information.shape[-1]
    first = pairs.rotations[:, 0]
    apart = Rotation.from_matrix(pairs.rotations[:, 1] @ np.swapaxes(first, 1, 2)).as_rotvec()
    turn = np.zeros((count, 2, 3))
    turn[:, 1] = np.where(weights[:, 1:] > 0, apart, 0.0)
    places = np.concatenate([pairs.translations_m, turn], axis=-1)
    mean = (weights[..., None] * places).sum(axis=1)
    away = np.where(weights[..., None] > 0, places - mean[:, None], 0.0)
    spreads, _ = inverse_information(pairs.information.reshape(-1, size, size))
    spreads = spreads.reshape(count, 2, 6, 6) + away[..., :, None] * away[..., None, :]
    covariance = (weights[..., None, None] * spreads).sum(axis=1)
    rotations = Rotation.from_rotvec(mean[:, 3:]).as_matrix() @ first
    return rotations, mean[:, :3], covariance
