"""Methods `joint`, `joint-hub` and `joint-robust`: the pose that best explains the features in both eyes at once."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from geometry.se3 import Array, RigidTransform
from nav.pose.adjustment import AdjustedPoses, AdjustmentState, Loss, adjust, linearise, project_features
from nav.pose.features import Features, observed_features
from nav.pose.joint_batch import JointBatch, adjust_both_tilts, solve_features, two_fold_starts
from nav.pose.observation_checks import hub_fault, stereo_fault
from nav.pose.pose_method import NoFixReason, Observation, PoseMode, Solution

# Largest root mean square residual of a drogue's features: a share of a marker's radius, and at least these pixels.
_LARGEST_MISS_FRACTION = 0.5
_LEAST_MISS_PX = 3.0
_HUBER = Loss(huber_sigmas=2.0)
# A feature in both eyes has four residuals; chance exceeds this chi-square once in 2000.
_LARGEST_CHI2 = 20.0
# Residuals less likely than this are not noise.
_LEAST_CHANCE = 1e-4
# Two outliers can be identified when at least five more features remain.
_LEAST_FOR_TWO_OUT = 7
# Four markers overdetermine the plane that three determine.
_LEAST_INLIERS = 4


def joint(observation: Observation) -> Solution | NoFixReason:
    """Method `joint`: weighted least squares over all markers in both eyes, from both weak-perspective attitudes.

    See `nav.pose.joint_batch` for the pose where the sign of the tilt is ambiguous.
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
    return Solution(pose, used, batch.covariances[0], _modes(batch), used_hub, note)


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
    as a feature.
    """
    reason = stereo_fault(observation) or hub_fault(observation)
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
    all_chi2 = _feature_chi2(features.take(np.zeros(2, dtype=np.int64)), tilts)[best]
    if (all_chi2 < _LARGEST_CHI2).all():
        return np.ones(len(all_chi2), dtype=bool)
    copies = features.take(np.zeros(2 * len(_leave_out_sets(features)), dtype=np.int64))
    left_out = np.repeat(_leave_out_sets(features), 2, axis=0)
    subsets = copies.without(left_out)
    starts = two_fold_starts(subsets.take(slice(0, None, 2)))
    adjusted = adjust(subsets, starts[0].reshape(-1, 3, 3), starts[1].reshape(-1, 3))
    chi2 = np.vstack([_feature_chi2(copies, adjusted), all_chi2])
    scores = np.minimum(chi2, _LARGEST_CHI2).sum(axis=1)
    inliers: NDArray[np.bool_] = chi2[np.argmin(scores)] < _LARGEST_CHI2
    if (inliers & features.is_marker & _measured_features(features)).sum() < _LEAST_INLIERS:
        best_subset = int(np.argmin(np.where(left_out, 0.0, chi2[:-1]).sum(axis=1)))
        kept: NDArray[np.bool_] = ~left_out[best_subset]
        if _is_consistent(features, kept, chi2[best_subset]):
            return kept
    return inliers


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


def _feature_chi2(features: Features, adjusted: AdjustedPoses) -> Array:
    """(S, F) chi-squares of every feature, summed over the eyes; infinite where they are nan."""
    state = AdjustmentState(adjusted.rotations, adjusted.translations_m, adjusted.departures)
    size = 2 * features.measured.shape[2] * len(features.points_m)
    residuals = linearise(features, state).residuals[:, :size]
    squares = (residuals.reshape(len(residuals), -1, len(features.points_m)) ** 2).sum(axis=1)
    return np.where(np.isfinite(squares), squares, np.inf)


def _measured_features(features: Features) -> NDArray[np.bool_]:
    """(F,) which features any eye of the first frame measured."""
    seen: NDArray[np.bool_] = features.seen[0].any(axis=0)
    return seen
