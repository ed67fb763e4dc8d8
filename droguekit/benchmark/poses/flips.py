"""Mirrored tilts: a flat ring far away looks nearly the same tilted one way or the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from droguekit.benchmark.poses.bounds import angles_jacobian
from droguekit.benchmark.poses.centroid_errors import CentroidErrors
from droguekit.benchmark.poses.closed_forms import FacingRing, flip_probability
from droguekit.benchmark.poses.frame_truth import DrogueTruth
from droguekit.benchmark.results.result_parts import Flips
from droguekit.benchmark.statistics import fraction_interval
from geometry.se3 import Array, RigidTransform, angles_from_axis, rotation_from_angles

# A tilt below this many standard deviations is not told from none, and so has no sign to get wrong.
_CLEAR_TILT = 5.0

_OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class FlipTrial:
    """One pose whose true tilt is clear.

    Attributes:
        flipped: the estimated (pitch, yaw) points away from the true one.
        predicted: probability by the flip law, None where it does not hold.
    """

    flipped: bool
    predicted: float | None


@dataclass(frozen=True)
class FlipTrials:
    """One pose as seen along the optical axis and along the line of sight; None where the tilt is not clear."""

    optical: FlipTrial | None
    sight: FlipTrial | None


def flip_trials(
    estimate: RigidTransform, truth: DrogueTruth, covariance: Array, tilt_scale_rad: float | None
) -> FlipTrials:
    """Whether a tilt came out mirrored.

    Args:
        estimate: `left_from_drogue`.
        truth: of the same pair.
        covariance: (6, 6) Cramer-Rao bound of the pose. [m, rad]
        tilt_scale_rad: of the flip law (`ring_tilt_scale`), None where the law does not hold. [rad]
    """
    sight = _sight_m(truth)
    sight = sight / np.linalg.norm(sight)
    optical, along = (
        _trial(estimate, truth.left_from_drogue, covariance, direction, tilt_scale_rad)
        for direction in (_OPTICAL_AXIS, sight)
    )
    return FlipTrials(optical, along)


def ring_tilt_scale(truth: DrogueTruth, centroids: CentroidErrors, sigma_px: float) -> float | None:
    """Scale of the flip law for the markers that a pose rests on, None where it rests on more or less than a ring.

    With the distance along the line of sight, about which a tilt is mirrored, in place of the depth.

    Args:
        truth: the drogue.
        centroids: that were measured.
        sigma_px: their noise. [px]
    """
    layout, used = truth.layout, centroids.used
    both = np.bincount(centroids.eye[used], minlength=2)
    if layout.ring_radius_m is None or centroids.is_hub[used].any() or both.min() < 3:
        return None
    camera = truth.rig.camera
    focal_px = float(np.sqrt(camera.fx_px * camera.fy_px))
    distance_m = float(np.linalg.norm(_sight_m(truth)))
    ring = FacingRing(focal_px, truth.rig.baseline_m, layout.ring_radius_m, round(float(both.mean())), distance_m)
    return sigma_px * ring.tilt_rad


def flip_row(trials: Sequence[FlipTrial]) -> Flips:
    """Share of flips among poses of clear tilt, and what the law predicts for the same poses."""
    count, hits = len(trials), sum(trial.flipped for trial in trials)
    predicted = [trial.predicted for trial in trials if trial.predicted is not None]
    return Flips(
        n=count,
        flips=hits,
        rate=hits / count if count else None,
        interval=fraction_interval(hits, count) if count else None,
        predicted=float(np.mean(predicted)) if count and len(predicted) == count else None,
    )


def _sight_m(truth: DrogueTruth) -> Array:
    """(3,) from the middle of the eyes to the drogue."""
    sight: Array = truth.left_from_drogue.translation_m - np.array([truth.rig.baseline_m / 2, 0.0, 0.0])
    return sight


def _trial(
    estimate: RigidTransform, truth: RigidTransform, covariance: Array, direction: Array, tilt_scale_rad: float | None
) -> FlipTrial | None:
    pitch, yaw = angles_from_axis(direction)
    looking = RigidTransform(rotation_from_angles(float(pitch), float(yaw), 0.0), np.zeros(3)).inverse()
    seen, true = looking @ estimate, looking @ truth
    tilt, estimated = (np.array(angles_from_axis(pose.rotation[:, 2])) for pose in (true, seen))
    size = float(np.linalg.norm(tilt))
    slope = angles_jacobian(true) @ looking.rotation
    angles = slope @ covariance[3:, 3:] @ slope.T
    # size > 5 sqrt(g C g^T) with g = tilt / size, without the division that a tilt of exactly zero forbids.
    if size**2 <= _CLEAR_TILT * np.sqrt(tilt @ angles @ tilt):
        return None
    predicted = None if tilt_scale_rad is None else flip_probability(size, tilt_scale_rad)
    return FlipTrial(bool(estimated @ tilt < 0), predicted)
