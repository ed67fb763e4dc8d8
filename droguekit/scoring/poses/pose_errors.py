"""Errors of one pose: components, consistency with covariances and bounds, mirrored tilts, rangefinder readings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from datasets_manifest.types.estimates import TANGENT, Estimate, PoseEstimate
from droguekit.scoring.confidence_intervals import (
    fraction_interval,
    mean_square_region,
    rms_upper_limit,
    root_mean_square,
)
from droguekit.scoring.poses.centroid_errors import CentroidErrors
from droguekit.scoring.poses.cramer_rao import FacingRing, angles_jacobian, component_covariance, flip_probability
from droguekit.scoring.poses.drogue_truth import DrogueTruth
from droguekit.scoring.results.pose_result import (
    ComponentRatios,
    DepthErrors,
    Flips,
    Nees,
    NeesPart,
    NormalizedErrors,
    RangefinderErrors,
)
from geometry.se3 import Array, RigidTransform, angles_from_axis, rotation_from_angles

COMPONENTS = ("x", "y", "z", "pitch", "yaw")
"""Order of errors and bounds: X, Y, Z in the left camera [m], then pitch and yaw [deg]."""
# Larger than any length, speed or time in flight; its square is far from overflow.
_LARGEST_PLAUSIBLE = 1e9
Parts = Mapping[str, slice]
MOST_METHODS = 100
"""Most methods that are scored together: each has rows, plots and comparisons with the others."""
# Difference of the correlations above and below the diagonal; printed digits and floats of 32 bits stay below it.
_MOST_ASYMMETRY = 1e-3
# A larger square means that the covariance is meaningless; it would dominate every mean.
_MOST_SQUARE = 1e100
# Position, attitude and both together, as slices of the five components.
_PARTS: Parts = {"position": slice(0, 3), "attitude": slice(3, 5), "pose": slice(0, 5)}
# A tilt below this many standard deviations cannot be docking from zero, so its sign means nothing.
_CLEAR_TILT = 5.0
_OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class PoseError:
    """Estimate minus truth, for one pair.

    Attributes:
        components: (5,) X, Y, Z in the left camera [m], pitch and yaw of the axis [deg].
        transverse_m: length of the part across the line of sight to the true rim centre. [m]
    """

    components: Array
    transverse_m: float

    @property
    def position_m(self) -> float:
        """Length of the position error. [m]"""
        return float(np.linalg.norm(self.components[:3]))


def pose_error(estimate: RigidTransform, truth: RigidTransform) -> PoseError:
    """Error of a pose; roll does not count, for equal markers leave it open.

    Angles are compared as pitch and yaw of the axis, each difference in (-180, 180]. [deg]
    """
    offset = estimate.translation_m - truth.translation_m
    sight = truth.translation_m / np.linalg.norm(truth.translation_m)
    across = offset - (offset @ sight) * sight
    pitch, yaw = angles_from_axis(np.stack([estimate.rotation[:, 2], truth.rotation[:, 2]]))
    turns = np.rad2deg([pitch[0] - pitch[1], yaw[0] - yaw[1]])
    wrapped = 180.0 - np.mod(180.0 - turns, 360.0)
    return PoseError(np.concatenate([offset, wrapped]), float(np.linalg.norm(across)))


def estimates_by_method(
    estimates: Iterable[Estimate], frame_indices: Iterable[int], source: str
) -> dict[str, dict[int, Estimate]]:
    """Estimates by method and frame, methods in the order of the file.

    Args:
        estimates: all of a file.
        frame_indices: the dataset's pairs.
        source: what to call the file in errors.

    Raises:
        ValueError: no estimates, too many methods, an estimate for a pair that the dataset lacks, two of a method for
            the same pair, or a number that is implausibly large.
    """
    known = set(frame_indices)
    methods: dict[str, dict[int, Estimate]] = {}
    for estimate in estimates:
        index, method = estimate.frame_index, estimate.method
        if index not in known:
            raise ValueError(f"{source}: method {method!r}: frame {index} is not in the dataset")
        frames = methods.setdefault(method, {})
        if len(methods) > MOST_METHODS:
            raise ValueError(f"{source}: holds more than {MOST_METHODS} methods; split it and score the parts")
        if index in frames:
            raise ValueError(f"{source}: method {method!r}: frame {index} occurs twice")
        largest = _largest_number(estimate)
        if largest > _LARGEST_PLAUSIBLE:
            raise ValueError(
                f"{source}: method {method!r}: frame {index}: lengths, speeds and times must be at most "
                f"{_LARGEST_PLAUSIBLE:g} in SI units, got {largest:g}"
            )
        frames[index] = estimate
    if not methods:
        raise ValueError(f"{source}: holds no estimates; run an estimator on this dataset first")
    return methods


def _largest_number(estimate: Estimate) -> float:
    """The largest length, speed or time of an estimate. [m, m/s, rad/s, s]"""
    numbers = [estimate.latency_s or 0.0, *estimate.stage_s.values()]
    if isinstance(estimate, PoseEstimate):
        numbers += estimate.left_from_drogue.translation_m.tolist()
        if estimate.motion is not None:
            numbers += [*estimate.motion.velocity_m_s, *estimate.motion.rate_rad_s]
        if estimate.docking is not None:
            docking = estimate.docking
            numbers += [*docking.mouth_from_tip_m, *docking.mouth_sd_m]
            numbers += [
                docking.closure_m_s or 0.0,
                docking.miss_m or 0.0,
                docking.miss_sd_m or 0.0,
                docking.contact_s or 0.0,
            ]
            numbers.append(docking.capture_radius_m or 0.0)
    return max(abs(number) for number in numbers)


@dataclass(frozen=True)
class RangefinderSample:
    """Three depths of one pair, all along the left camera's optical axis.

    Attributes:
        estimated_m, true_m: of the rim's centre. [m]
        reading_m: the rangefinder's reading of it. [m]
    """

    estimated_m: float
    true_m: float
    reading_m: float


def rangefinder_errors(depths: Sequence[RangefinderSample]) -> RangefinderErrors | None:
    """Depth errors against the readings and against the truth; None without a depth."""
    if not depths:
        return None
    estimated, true, reading = np.array([[depth.estimated_m, depth.true_m, depth.reading_m] for depth in depths]).T
    return RangefinderErrors(
        n=len(depths),
        against_reading=_errors(estimated, reading),
        against_truth=_errors(estimated, true),
        reading=_errors(reading, true),
    )


def _errors(values_m: NDArray[np.float64], reference_m: NDArray[np.float64]) -> DepthErrors:
    errors = values_m - reference_m
    return DepthErrors(
        bias_m=float(errors.mean()),
        rmse_m=root_mean_square(errors),
        mean_absolute_m=float(np.abs(errors).mean()),
        mean_absolute_fraction=float((np.abs(errors) / reference_m).mean()),
    )


def squared_errors(estimate: PoseEstimate, error: PoseError) -> Array | None:
    """Normalized estimation error squared of position, attitude and both.

    Args:
        estimate: with a covariance.
        error: of its pose.

    Returns:
        (3,) of 3, 2 and 5 degrees of freedom, or None where the covariance is not symmetric and positive definite, too
        small or too large for floats, or in another tangent than ours.

    Source: e^T C^-1 e, Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4.
    """
    if estimate.covariance is None or estimate.tangent != TANGENT:
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = component_covariance(estimate.left_from_drogue, estimate.covariance)
    return normalized_squares(error.components, covariance, _PARTS)


def normalized_squares(error: Array, covariance: Array, parts: Parts) -> Array | None:
    """(len(parts),) `e^T C^-1 e` of parts of an error.

    Returns:
        None where the covariance is not symmetric and positive definite, or too small or too large for floats.
    """
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0))
    if not deviations.all():
        return None
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        scaled, whole = covariance / np.outer(deviations, deviations), error / deviations
        if not np.isfinite(scaled).all() or np.abs(scaled - scaled.T).max() > _MOST_ASYMMETRY:
            return None
        try:
            squares = np.array(
                [whole[part] @ cho_solve(cho_factor(scaled[part, part]), whole[part]) for part in parts.values()]
            )
        except (LinAlgError, ValueError):
            # The latter where the error over its deviation is no float.
            return None
    return squares if (squares < _MOST_SQUARE).all() else None


def nees_parts(squares: Array, parts: Parts) -> dict[str, NeesPart]:
    """Means over (n, len(parts)) `normalized_squares`; empty without any."""
    if not len(squares):
        return {}
    found = {}
    for k, (name, part) in enumerate(parts.items()):
        freedom = part.stop - part.start
        low, high = mean_square_region(freedom * len(squares))
        found[name] = NeesPart(freedom=freedom, per_freedom=float(squares[:, k].mean()) / freedom, low=low, high=high)
    return found


def nees(squares: Sequence[Array | None]) -> Nees | None:
    """Mean over the poses that come with a covariance; None without any.

    Args:
        squares: `squared_errors` of each.
    """
    if not squares:
        return None
    usable = np.array([row for row in squares if row is not None])
    parts = nees_parts(usable, _PARTS)
    return Nees(
        n=len(usable),
        unusable=len(squares) - len(usable),
        position=parts.get("position"),
        attitude=parts.get("attitude"),
        pose=parts.get("pose"),
    )


def normalized_errors(pairs: Sequence[tuple[PoseError, Array]]) -> NormalizedErrors | None:
    """Root mean square of errors over the (5,) bound of their frame, with its upper limit; None without any."""
    if not pairs:
        return None
    ratios = np.array([error.components / bound for error, bound in pairs])
    nrms = dict(zip(COMPONENTS, (root_mean_square(column) for column in ratios.T), strict=True))
    upper = {name: rms_upper_limit(value, len(pairs)) for name, value in nrms.items()}
    return NormalizedErrors(n=len(pairs), nrms=ComponentRatios(**nrms), upper=ComponentRatios(**upper))


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
    """Scale of the flip law for the markers that a pose was computed from; None unless these form a ring in each eye.

    The distance along the line of sight, about which a tilt is mirrored, replaces the depth.

    Args:
        truth: the drogue.
        centroids: that were measured.
        sigma_px: their noise. [px]
    """
    layout, used = truth.layout, centroids.used
    both = np.bincount(centroids.eye[used], minlength=2)
    if layout.ring_radius_m is None or centroids.is_hub[used].any() or both.min() < 3:
        return None
    distance_m = float(np.linalg.norm(_sight_m(truth)))
    ring = FacingRing(
        truth.rig.delivered_focal_px, truth.rig.baseline_m, layout.ring_radius_m, round(float(both.mean())), distance_m
    )
    return sigma_px * ring.tilt_rad


def flip_statistics(trials: Sequence[FlipTrial]) -> Flips:
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
