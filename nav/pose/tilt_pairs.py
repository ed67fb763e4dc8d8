"""The two poses that explain a flat ring far away, tilted one way and the other: starts, weights and their mixture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geometry.se3 import Array
from nav.numerics.cholesky import factorise
from nav.numerics.compiled import compiled, is_finite
from nav.pose.adjustment import AdjustedPoses, contiguous, inverse_information
from nav.pose.features import Features

# Starts that end closer to each other than this found one minimum.
SAME_TURN_RAD = 1e-4
# Keeps the affine fit of collinear markers solvable; negligible for all others.
_RIDGE_FRACTION = 1e-12
# Keeps the distance of coincident images finite; the cost of the adjustment is high anyway.
_LEAST_SCALE = float(np.finfo(np.float64).tiny) ** 0.5


@dataclass(frozen=True, eq=False)
class TiltPairs:
    """Adjusted poses from both starts of B frames, (B, 2, ...)."""

    rotations: Array
    translations_m: Array
    costs: Array
    information: Array

    @staticmethod
    def of(adjusted: AdjustedPoses) -> TiltPairs:
        """The pairs among 2 B poses, the two of a frame after each other."""
        size = adjusted.information.shape[-1]
        return TiltPairs(
            adjusted.rotations.reshape(-1, 2, 3, 3),
            adjusted.translations_m.reshape(-1, 2, 3),
            adjusted.costs.reshape(-1, 2),
            adjusted.information.reshape(-1, 2, size, size),
        )

    def ordered(self, order: NDArray[np.int64]) -> TiltPairs:
        """The pairs with their members in (B, 2) orders."""
        rows = np.arange(len(order))[:, None]
        return TiltPairs(*(values[rows, order] for values in vars(self).values()))

    def replace(self, frames: NDArray[np.int64], other: TiltPairs) -> None:
        """Put the pairs of other poses in the places of these frames."""
        for own, replacement in zip(vars(self).values(), vars(other).values(), strict=True):
            own[frames] = replacement


def two_fold_starts(features: Features) -> tuple[Array, Array]:
    """Both weak-perspective poses of the ring's markers that every eye measured.

    The affine map from the rim plane to the image, averaged over the eyes, is scale times the first two columns of the
    attitude without their third components. The common sign of these is undetermined, hence two poses.

    Args:
        features: B frames with at least three markers that all eyes measured, and that are not collinear.

    Returns:
        rotations (B, 2, 3, 3) `left_from_drogue`, translations (B, 2, 3) [m]; NaN for frames with fewer markers.
    """
    camera, frames = features.camera, features.frames
    rotations, translations_m = np.empty((frames, 2, 3, 3)), np.empty((frames, 2, 3))
    pinhole = (float(camera.fx_px), float(camera.fy_px), float(camera.cx_px), float(camera.cy_px))
    places_m = np.ascontiguousarray(features.points_m[features.is_marker, :2])
    measured = np.ascontiguousarray(features.measured[:3, ..., features.is_marker])
    _fill_starts(pinhole, float(features.eye_x_m.mean()), places_m, measured, rotations, translations_m)
    return rotations, translations_m


@compiled
def _fill_starts(
    pinhole: tuple[float, float, float, float],
    middle_x_m: float,
    places_m: Array,
    measured: Array,
    rotations: Array,
    translations_m: Array,
) -> None:
    """Fill the starts of `two_fold_starts`.

    Args:
        pinhole: fx, fy, cx, cy. [px]
        middle_x_m: between the eyes, along x of the left camera.
        places_m: (N, 2) of the markers in the rim plane.
        measured: (3, B, E, N) horizontal and vertical pixel, and a number above 0 where there was a measurement.
        rotations: (B, 2, 3, 3), filled.
        translations_m: (B, 2, 3), filled.
    """
    fx, fy, cx, cy = pinhole
    linear, columns = np.empty((2, 2)), np.empty((3, 2))
    sight, nearest = np.empty((3, 3)), np.empty((3, 3))
    for b in range(measured.shape[1]):
        center_u, center_v = _fill_affine_map(places_m, measured[:, b], linear)
        for column in range(2):
            linear[0, column] /= fx
            linear[1, column] /= fy
        x, y = (center_u - cx) / fx, (center_v - cy) / fy
        even = np.hypot(linear[0, 0] + linear[1, 1], linear[0, 1] - linear[1, 0])
        odd = np.hypot(linear[0, 0] - linear[1, 1], linear[0, 1] + linear[1, 0])
        scale = max((even + odd) / 2, _LEAST_SCALE)
        length = np.sqrt(x * x + y * y + 1)
        _fill_line_of_sight(x / length, y / length, 1 / length, sight)
        for column in range(2):
            columns[0, column], columns[1, column] = linear[0, column] / scale, linear[1, column] / scale
            rest = 1 - columns[0, column] ** 2 - columns[1, column] ** 2
            columns[2, column] = np.sqrt(max(rest, 0.0))
        # The columns are at right angles.
        if columns[0, 0] * columns[0, 1] + columns[1, 0] * columns[1, 1] >= 0:
            columns[2, 1] = -columns[2, 1]
        for side in range(2):
            if side == 1:
                columns[2, 0], columns[2, 1] = -columns[2, 0], -columns[2, 1]
            _fill_nearest_rotation(columns, nearest)
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(3):
                        total += sight[i, k] * nearest[k, j]
                    rotations[b, side, i, j] = total
            translations_m[b, side, 0] = x / scale + middle_x_m
            translations_m[b, side, 1], translations_m[b, side, 2] = y / scale, 1 / scale


@compiled
def _mean_pixel(measured: Array, marker: int) -> tuple[float, float, bool]:
    """A marker's mean pixel over all eyes, and whether every eye measured it."""
    u, v, is_paired, eyes = 0.0, 0.0, True, measured.shape[1]
    for eye in range(eyes):
        u += measured[0, eye, marker] / eyes
        v += measured[1, eye, marker] / eyes
        is_paired &= measured[2, eye, marker] > 0
    return u, v, is_paired


@compiled
def _fill_affine_map(places_m: Array, measured: Array, linear: Array) -> tuple[float, float]:
    """Fill the linear part (2, 2) of the affine map from rim plane to mean image; returns the image of the origin. [px]

    Markers that an eye did not measure are left out.
    """
    count, mean_x, mean_y, mean_u, mean_v = 0, 0.0, 0.0, 0.0, 0.0
    for f in range(len(places_m)):
        u, v, is_paired = _mean_pixel(measured, f)
        if is_paired:
            # The mean so far, moved by its share of the next one.
            count += 1
            mean_x += (places_m[f, 0] - mean_x) / count
            mean_y += (places_m[f, 1] - mean_y) / count
            mean_u += (u - mean_u) / count
            mean_v += (v - mean_v) / count
    xx, xy, yy, xu, xv, yu, yv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for f in range(len(places_m)):
        u, v, is_paired = _mean_pixel(measured, f)
        if is_paired:
            x, y = places_m[f, 0] - mean_x, places_m[f, 1] - mean_y
            u, v = u - mean_u, v - mean_v
            xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
            xu, xv, yu, yv = xu + x * u, xv + x * v, yu + y * u, yv + y * v
    ridge = _RIDGE_FRACTION * (xx + yy)
    xx, yy = xx + ridge, yy + ridge
    determinant = xx * yy - xy * xy
    linear[0, 0], linear[0, 1] = (yy * xu - xy * yu) / determinant, (xx * yu - xy * xu) / determinant
    linear[1, 0], linear[1, 1] = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    origin_u = mean_u - linear[0, 0] * mean_x - linear[0, 1] * mean_y
    origin_v = mean_v - linear[1, 0] * mean_x - linear[1, 1] * mean_y
    return origin_u, origin_v


@compiled
def _fill_line_of_sight(x: float, y: float, z: float, rotation: Array) -> None:
    """Fill the smallest rotation (3, 3) from the optical axis to a unit vector with positive z."""
    rotation[0, 2], rotation[1, 2], rotation[2, 2] = x, y, z
    rotation[2, 0], rotation[2, 1] = -x, -y
    rotation[0, 0], rotation[1, 1] = 1 - x * x / (1 + z), 1 - y * y / (1 + z)
    rotation[0, 1] = rotation[1, 0] = -x * y / (1 + z)


@compiled
def _fill_nearest_rotation(columns: Array, rotation: Array) -> None:
    """Fill the rotation (3, 3) whose first two columns are nearest to two columns (3, 2); NaN where these are parallel.

    It is the polar factor `C (C^T C)^(-1/2)`, whose root has a closed form for 2x2 matrices.
    """
    aa, ab, bb = 0.0, 0.0, 0.0
    for k in range(3):
        aa += columns[k, 0] * columns[k, 0]
        ab += columns[k, 0] * columns[k, 1]
        bb += columns[k, 1] * columns[k, 1]
    area = np.sqrt(aa * bb - ab * ab)
    root = area * np.sqrt(aa + bb + 2 * area)
    for k in range(3):
        first, second = columns[k, 0], columns[k, 1]
        rotation[k, 0] = ((bb + area) * first - ab * second) / root
        rotation[k, 1] = ((aa + area) * second - ab * first) / root
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        rotation[k, 2] = rotation[i, 0] * rotation[j, 1] - rotation[j, 0] * rotation[i, 1]


def line_of_sight_rotations(directions: Array) -> Array:
    """(B, 3, 3) smallest rotations from the optical axis to (B, 3) directions with positive z."""
    rotations = np.empty((len(directions), 3, 3))
    _fill_lines_of_sight(contiguous(directions), rotations)
    return rotations


@compiled
def _fill_lines_of_sight(directions: Array, rotations: Array) -> None:
    for b in range(len(directions)):
        x, y, z = directions[b]
        length = np.sqrt(x * x + y * y + z * z)
        _fill_line_of_sight(x / length, y / length, z / length, rotations[b])


def mode_weights(pairs: TiltPairs, prior_rad: float) -> Array:
    """(B, 2) posterior probabilities by Laplace's approximation, `exp(-cost) |information|^(-1/2)` times a tilt prior.

    They are zero for a pose behind the cameras and for the second of two equal poses. A frame with only impossible
    poses keeps the first, which is not sound.
    """
    weights = np.empty(pairs.costs.shape)
    poses = contiguous(pairs.rotations), contiguous(pairs.translations_m)
    _fill_weights(*poses, contiguous(pairs.costs), contiguous(pairs.information), float(prior_rad), weights)
    return weights


@compiled
def _fill_weights(
    rotations: Array, translations_m: Array, costs: Array, information: Array, prior_rad: float, weights: Array
) -> None:
    lower, ones = np.empty(information.shape[2:]), np.ones(information.shape[2])
    for b in range(len(weights)):
        turned2 = 0.0
        for k in range(3):
            turned2 += (rotations[b, 0, k, 2] - rotations[b, 1, k, 2]) ** 2
        for side in range(2):
            axis_x, axis_y = rotations[b, side, 0, 2], rotations[b, side, 1, 2]
            # The root of the determinant is the product of the factor's diagonal; NaN for a matrix that has none.
            factorise(information[b, side], ones, 0.0, lower)
            log_weight = -costs[b, side]
            for k in range(len(lower)):
                log_weight -= np.log(lower[k, k])
            log_weight -= (axis_x * axis_x + axis_y * axis_y) / (2 * prior_rad * prior_rad)
            is_ahead = rotations[b, side, 2, 2] > 0 and translations_m[b, side, 2] > 0
            is_other = side == 0 or turned2 > SAME_TURN_RAD**2
            weights[b, side] = log_weight if is_ahead and is_other and is_finite(log_weight) else -np.inf
        if not is_finite(weights[b, 0]) and not is_finite(weights[b, 1]):
            weights[b, 0] = 0.0
        most = max(weights[b, 0], weights[b, 1])
        first, second = np.exp(weights[b, 0] - most), np.exp(weights[b, 1] - most)
        weights[b, 0], weights[b, 1] = first / (first + second), second / (first + second)


def mixture_mean(pairs: TiltPairs, weights: Array) -> tuple[Array, Array, Array]:
    """Mean rotations (B, 3, 3), translations (B, 3) and covariances (B, 6, 6) of mixtures of two Gaussians."""
    count, size = len(weights), pairs.information.shape[-1]
    first = pairs.rotations[:, 0]
    turn_between = Rotation.from_matrix(pairs.rotations[:, 1] @ np.swapaxes(first, 1, 2)).as_rotvec()
    turn = np.zeros((count, 2, 3))
    turn[:, 1] = np.where(weights[:, 1:] > 0, turn_between, 0.0)
    positions = np.concatenate([pairs.translations_m, turn], axis=-1)
    mean = (weights[..., None] * positions).sum(axis=1)
    offsets = np.where(weights[..., None] > 0, positions - mean[:, None], 0.0)
    spreads, _ = inverse_information(pairs.information.reshape(-1, size, size))
    spreads = spreads.reshape(count, 2, 6, 6) + offsets[..., :, None] * offsets[..., None, :]
    covariance = (weights[..., None, None] * spreads).sum(axis=1)
    rotations = Rotation.from_rotvec(mean[:, 3:]).as_matrix() @ first
    return rotations, mean[:, :3], covariance
