"""Methods `joint`, `joint-hub` and `joint-robust`: the pose that best explains the features in both eyes at once.

Many frames are adjusted at once, each from two starts, tilted one way and the other, because a flat pattern far away
allows both. Where the ring alone does not tell which tilt is right, the reported pose is the posterior's mean over
both, with the covariance of the mixture. Elsewhere it is the minimum with the lower cost, with the inverse information
as covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtrc, chdtri

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig
from nav.pose.adjustment import (
    SQUARED_LOSS,
    AdjustedPoses,
    AdjustmentState,
    Loss,
    adjust,
    information_at,
    inverse_information,
    linearise,
    project_features,
)
from nav.pose.features import Features, observed_features, stack_features
from nav.pose.pose_method import (
    EXACT,
    NoFixReason,
    Observation,
    PoseMode,
    Solution,
    StatedTolerances,
    hub_fault,
    stereo_fault,
)
from nav.pose.tilt_pairs import TiltPairs, line_of_sight_rotations, mixture_mean, mode_weights, two_fold_starts

# Standard deviation of pitch and of yaw for drogues that swing uniformly within 10 degrees: 5.8 degrees.
TILT_PRIOR_RAD = np.radians(6.0)
# The sign of a tilt is reliable beyond this many standard deviations of the tilt of a frontal drogue: wrong in 0.1 %.
RELIABLE_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class JointBatch:
    """Poses of B frames.

    Attributes:
        rotations: (B, 3, 3) `left_from_drogue`.
        translations_m: (B, 3).
        covariances: (B, 6, 6) in the tangent of `datasets_manifest.types.estimates`.
        sound: (B,) whether the measurements determine a pose in front of the cameras; the other values of a frame are
            meaningless, often NaN, where they do not.
        tilt_sign_reliable: (B,) whether the tilt is large enough for its sign to be certain.
        mode_rotations: (B, 2, 3, 3) the poses from both starts, the best first.
        mode_translations_m: (B, 2, 3).
        mode_costs: (B, 2) half the sum of squared residuals in standard deviations, priors included.
        mode_weights: (B, 2) posterior probabilities; the second is 0 where both starts led to the same pose.
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
    tilts = TiltPairs.of(adjust_both_tilts(features, *two_fold_starts(features)))
    tilts = tilts.ordered(np.argsort(tilts.costs, axis=1, kind="stable"))
    best_rotations, best_translations = tilts.rotations[:, 0], tilts.translations_m[:, 0]
    covariances, sound = inverse_information(tilts.information[:, 0])
    sound &= np.isfinite(tilts.costs[:, 0]) & (best_rotations[:, 2, 2] > 0) & (best_translations[:, 2] > 0)
    weights = mode_weights(tilts, TILT_PRIOR_RAD)
    reliable = _tilt_sign_reliable(features, best_rotations, best_translations) | ~sound

    rotations, translations = best_rotations.copy(), best_translations.copy()
    ambiguous = np.flatnonzero(~reliable)
    if len(ambiguous):
        starts = (tilts.rotations[ambiguous], tilts.translations_m[ambiguous])
        with_prior, prior_weights = _adjust_with_tilt_prior(features.take(ambiguous), *starts)
        rotations[ambiguous], translations[ambiguous], covariances[ambiguous] = mixture_mean(with_prior, prior_weights)
        tilts.replace(ambiguous, with_prior)
        weights[ambiguous] = prior_weights
    return JointBatch(
        rotations=rotations,
        translations_m=translations,
        covariances=covariances,
        sound=sound,
        tilt_sign_reliable=reliable & sound,
        mode_rotations=tilts.rotations,
        mode_translations_m=tilts.translations_m,
        mode_costs=tilts.costs,
        mode_weights=weights,
    )


def _adjust_with_tilt_prior(features: Features, rotations: Array, translations_m: Array) -> tuple[TiltPairs, Array]:
    """Adjust (B, 2) starts with the prior on the tilt, and order both by their weights (B, 2), the larger first."""
    tilts = TiltPairs.of(adjust_both_tilts(features, rotations, translations_m, Loss(tilt_prior_rad=TILT_PRIOR_RAD)))
    weights = mode_weights(tilts, np.inf)
    order = np.argsort(-weights, axis=1, kind="stable")
    return tilts.ordered(order), np.take_along_axis(weights, order, axis=1)


def adjust_both_tilts(
    features: Features, rotations: Array, translations_m: Array, loss: Loss = SQUARED_LOSS
) -> AdjustedPoses:
    """Adjust (B, 2) starts; returns 2 B poses, the two of a frame after each other."""
    twice = features.take(np.repeat(np.arange(features.frames), 2))
    return adjust(twice, rotations.reshape(-1, 3, 3), translations_m.reshape(-1, 3), loss)


def _tilt_sign_reliable(features: Features, rotations: Array, translations_m: Array) -> NDArray[np.bool_]:
    """(B,) whether the tilt against the line of sight exceeds three standard deviations of that of a frontal pose."""
    middle = np.array([features.eye_x_m.mean(), 0.0, 0.0])
    frontal = line_of_sight_rotations(translations_m - middle)
    covariance, determined = inverse_information(information_at(features, frontal, translations_m))
    variance = (covariance[:, 3, 3] + covariance[:, 4, 4]) / 2
    # The cosine of small tilts is lost in rounding; the cross product is not.
    ax, ay, az, bx, by, bz = (axes[:, k, 2] for axes in (rotations, frontal) for k in range(3))
    tilt = np.sqrt((ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2)
    reliable: NDArray[np.bool_] = determined & (tilt > RELIABLE_SIGMAS * np.sqrt(variance))
    return reliable


# Largest root mean square residual of a drogue's features: a share of a marker's radius, and at least these pixels.
_LARGEST_MISS_FRACTION = 0.5
_LEAST_MISS_PX = 3.0
_HUBER = Loss(huber_sigmas=2.0)
# A feature in both eyes has four residuals; chance exceeds this chi-square once in 2000.
_LARGEST_CHI2 = 20.0
# Residuals less likely than this are not noise.
_LEAST_CHANCE = 1e-4
# Where noise makes residuals as large once in so many frames, the stated noise is too small: 1 in a million.
_LEAST_CHANCE_OF_NOISE = 1e-6
# Two outliers can be identified when at least five more features remain.
_LEAST_FOR_TWO_OUT = 7
# Images of as many features as two outliers can be identified among.
_LEAST_FOR_A_VARIANCE = 2 * _LEAST_FOR_TWO_OUT
# Share of images whose residuals tell an error that all share. Such an error may be in one eye alone, which is half of
# them, while three outliers of eight in both eyes are three eighths.
_UNDER_A_COMMON_ERROR = 5 / 8
# Larger deviations that all images share are no error of a rig or drogue, but of many markers: these pixels, or this
# share of a marker's radius, 1.5 mm of 50.
_LARGEST_COMMON_PX, _LARGEST_COMMON_FRACTION = 1.0, 0.03
# Four markers overdetermine the plane that three determine.
_LEAST_INLIERS = 4


def joint(observation: Observation) -> Solution | NoFixReason:
    """Method `joint`: weighted least squares over all markers in both eyes, from both weak-perspective attitudes.

    See `nav.pose.joint` for the pose where the sign of the tilt is ambiguous. Where noise makes residuals as large once
    in a million frames, rig or drogue are not as stated, and the covariance is multiplied by Birge's ratio, the
    chi-square over its degrees of freedom.
    """
    return stereo_fault(observation) or solve_one(observed_features(observation, with_hub=False), observation.seen)


def joint_hub(observation: Observation) -> Solution | NoFixReason:
    """Method `joint-hub`: as `joint`, with the ellipse centres of the hub's edges, each with its own radius.

    The hub lies behind the rim plane, so it determines the sign of the tilt. Without a measured hub the solution is
    that of `joint`, with that method's large covariance, and a note.
    """
    reason = stereo_fault(observation) or hub_fault(observation)
    if reason is not None:
        return reason
    note = hub_note(observation)
    features = observed_features(observation, with_hub=True)
    return solve_one(features, observation.seen, None if note else observation.hub_seen, note)


def hub_note(observation: Observation) -> str:
    """Why a solution uses the markers only; empty when the hub was measured."""
    if observation.layout.hub_center_m is None:
        return "the drogue has no hub: the tilt rests on the markers alone"
    return "" if observation.hub_seen.any() else "no hub was measured: the tilt rests on the markers alone"


def solve_one(
    features: Features, used: NDArray[np.bool_], used_hub: NDArray[np.bool_] | None = None, note: str = ""
) -> Solution | NoFixReason:
    """Pose of one frame from its features, unless they do not fit the drogue."""
    batch = solve_features(features)
    if not batch.sound[0]:
        return NoFixReason("the adjustment found no pose in front of the cameras")
    reason = misfit_reason(features, batch.mode_rotations[0, 0], batch.mode_translations_m[0, 0])
    if reason is not None:
        return reason
    pose = RigidTransform(batch.rotations[0], batch.translations_m[0])
    covariance = _birge_ratio(features, batch) * batch.covariances[0]
    return Solution(pose, used, covariance, _modes(batch), used_hub, note)


def _birge_ratio(features: Features, batch: JointBatch) -> float:
    """Factor of one frame's covariance where the residuals are larger than the stated noise makes them; else 1.

    Source: R. T. Birge, doi:10.1103/PhysRev.40.207; the square of the Particle Data Group's scale factor,
    doi:10.1103/PhysRevD.110.030001, section 5.2.2. That widens every covariance, this one none that noise explains.
    """
    with_prior = 0 if batch.tilt_sign_reliable[0] else 2
    freedom = 2 * int(features.seen.sum()) + with_prior - 6
    chi2 = 2 * float(batch.mode_costs[0, 0])
    return chi2 / freedom if freedom > 0 and chdtrc(freedom, chi2) < _LEAST_CHANCE_OF_NOISE else 1.0


def _modes(batch: JointBatch) -> tuple[PoseMode, ...]:
    weights = batch.mode_weights[0]
    return tuple(
        PoseMode(RigidTransform(rotation, translation), float(cost), float(weight))
        for rotation, translation, cost, weight in zip(
            batch.mode_rotations[0], batch.mode_translations_m[0], batch.mode_costs[0], weights, strict=True
        )
        if weight > 0
    )


def misfit_reason(features: Features, rotation: Array, translation_m: Array) -> NoFixReason | None:
    """Why one frame's features do not fit the drogue in a pose; None when they do."""
    predicted = project_features(features, rotation[None], translation_m[None])
    squares = ((predicted - features.measured[:2].transpose(1, 2, 3, 0)) ** 2).sum(axis=-1)[features.seen]
    radius_px = features.camera.fx_px * features.radii_m[0] / translation_m[2]
    miss_px = float(np.sqrt(squares.mean()))
    if miss_px <= max(_LEAST_MISS_PX, _LARGEST_MISS_FRACTION * float(radius_px)):
        return None
    return NoFixReason(f"the markers do not fit the drogue: they miss their places by {miss_px:.1f} px (rms)")


def joint_robust(observation: Observation) -> Solution | NoFixReason:
    """Method `joint-robust`: as `joint-hub`, without outliers.

    The first adjustment uses Huber's loss. If any feature then is an outlier, the adjustment is repeated for every
    subset without one or two features. The subset with the smallest sum of clipped chi-squares determines the outliers.
    The solution is that of `joint-hub` (or `joint`, where no hub was measured) without them. An edge of the hub counts
    as a feature. Where most features have residuals that the stated noise does not explain, as with an error of the rig
    or the drogue, outliers are those that stick out from theirs.
    """
    reason = stereo_fault(observation, allows_outliers=True) or hub_fault(observation)
    if reason is not None:
        return reason
    features = observed_features(observation, with_hub=True)
    inliers = _inliers(features)
    count = observation.layout.count
    markers = int((inliers & _measured_features(features))[:count].sum())
    if not inliers.all() and markers < _LEAST_INLIERS:
        return NoFixReason(f"only {markers} markers agree with each other, {_LEAST_INLIERS} are needed")
    used, used_hub = observation.seen & inliers[:count], observation.hub_seen & _hub_inliers(inliers, count)
    paired = used.all(axis=0)
    if paired.sum() < 3:
        return NoFixReason(f"only {int(paired.sum())} markers that both eyes see agree with each other, 3 are needed")
    note = hub_note(observation)
    if not note and not used_hub.any():
        note = "the hub does not agree with the markers: the tilt rests on the markers alone"
    return solve_one(features.without(~inliers), used, used_hub if used_hub.any() else None, note)


def _hub_inliers(inliers: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    return inliers[count:] if len(inliers) > count else np.zeros(2, dtype=bool)


def _inliers(features: Features) -> NDArray[np.bool_]:
    """(F,) which features agree with the pose of the majority; unmeasured ones count as inliers."""
    tilts = adjust_both_tilts(features, *two_fold_starts(features), _HUBER)
    best = int(np.argmin(tilts.costs))
    robust_eye_chi2 = _eye_chi2(features.take(np.zeros(2, dtype=np.int64)), tilts)[best]
    robust_chi2 = robust_eye_chi2.sum(axis=0)
    if (robust_chi2 < _LARGEST_CHI2).all():
        return np.ones(len(robust_chi2), dtype=bool)
    copies = features.take(np.zeros(2 * len(_leave_out_sets(features)), dtype=np.int64))
    left_out = np.repeat(_leave_out_sets(features), 2, axis=0)
    subsets = copies.without(left_out)
    starts = two_fold_starts(subsets.take(slice(0, None, 2)))
    adjusted = adjust(subsets, starts[0].reshape(-1, 3, 3), starts[1].reshape(-1, 3))
    eye_chi2 = np.concatenate([_eye_chi2(copies, adjusted), robust_eye_chi2[None]])
    depth_m = float(tilts.translations_m[best, 2])
    chi2 = eye_chi2.sum(axis=1) / _common_variance(features, eye_chi2, depth_m)
    scores = np.minimum(chi2, _LARGEST_CHI2).sum(axis=1)
    inliers: NDArray[np.bool_] = chi2[np.argmin(scores)] < _LARGEST_CHI2
    if (inliers & features.is_marker & _measured_features(features)).sum() < _LEAST_INLIERS:
        best_subset = int(np.argmin(np.where(left_out, 0.0, chi2[:-1]).sum(axis=1)))
        kept: NDArray[np.bool_] = ~left_out[best_subset]
        if _is_consistent(features, kept, chi2[best_subset]):
            return kept
    return inliers


def _common_variance(features: Features, chi2: Array, depth_m: float) -> float:
    """Variance by which the residuals of most images exceed what the stated noise explains; 1 where it explains them.

    An error that all features share, of the rig or of the drogue, makes none of them an outlier.

    Args:
        features: one frame.
        chi2: (S, E, F) of every image of a feature, in several adjustments.
        depth_m: of the drogue. [m]

    Source: the least quantile over the adjustments, and the factor for few measurements, P. J. Rousseeuw and
    A. M. Leroy, Robust Regression and Outlier Detection (1987), doi:10.1002/0471725382.
    """
    images = chi2[:, features.seen[0]]
    count = images.shape[1]
    if count < _LEAST_FOR_A_VARIANCE:
        return 1.0
    rank = int(np.ceil(_UNDER_A_COMMON_ERROR * count))
    largest = float(np.sort(images, axis=1)[:, rank - 1].min())
    if bdtrc(count - rank, count, chdtrc(2, largest)) > _LEAST_CHANCE_OF_NOISE:
        return 1.0
    # An error of the drogue is the same in both eyes: as many measurements as images.
    few = 1 + 5 / (count - 6)
    variance = few**2 * largest / float(chdtri(2, 1 - _UNDER_A_COMMON_ERROR))
    sigma_px = float(np.median(1 / features.measured[2, 0][features.seen[0]]))
    radius_px = features.camera.fx_px * features.radii_m[0] / depth_m
    largest_px = max(_LARGEST_COMMON_PX, _LARGEST_COMMON_FRACTION * radius_px)
    return variance if np.sqrt(variance) * sigma_px <= largest_px else 1.0


def _is_consistent(features: Features, kept: NDArray[np.bool_], chi2: Array) -> bool:
    """Whether the kept features' sum of chi-squares is as small as noise makes it.

    Of four good markers, one is rejected by chance once in 500; their sum then shows that they are good.
    """
    freedom = 2 * int(features.seen[0][:, kept].sum()) - 6
    return freedom > 0 and float(chdtrc(freedom, chi2[kept].sum())) > _LEAST_CHANCE


def _leave_out_sets(features: Features) -> NDArray[np.bool_]:
    """(L, F) masks that leave out each measured feature, and each two where enough remain."""
    measured = np.flatnonzero(_measured_features(features))
    choices: list[tuple[int, ...]] = [(int(i),) for i in measured]
    if len(measured) >= _LEAST_FOR_TWO_OUT:
        choices += combinations(measured.tolist(), 2)
    left_out = np.zeros((len(choices), len(features.points_m)), dtype=bool)
    for row, choice in enumerate(choices):
        left_out[row, list(choice)] = True
    return left_out


def _eye_chi2(features: Features, adjusted: AdjustedPoses) -> Array:
    """(S, E, F) chi-squares of every feature in each eye; infinite where they are nan."""
    state = AdjustmentState(adjusted.rotations, adjusted.translations_m, adjusted.departures)
    eyes, count = features.measured.shape[2:]
    residuals = linearise(features, state).residuals[:, : 2 * eyes * count]
    squares = (residuals.reshape(-1, 2, eyes, count) ** 2).sum(axis=1)
    return np.where(np.isfinite(squares), squares, np.inf)


def _measured_features(features: Features) -> NDArray[np.bool_]:
    """(F,) which features any eye of the first frame measured."""
    seen: NDArray[np.bool_] = features.seen[0].any(axis=0)
    return seen
