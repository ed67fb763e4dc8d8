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

# Matched features miss their places by this share of a marker's own radius only when they are not the drogue's.
_LARGEST_MISS_FRACTION = 0.5
_LEAST_MISS_PX = 3.0


def joint(observation: Observation) -> Solution | NoFixReason:
    """Weighted least squares over all markers in both eyes, from both weak-perspective attitudes.

    See `nav.pose.joint_batch` for what is reported where the markers do not tell which way the drogue is tilted.
    """
    return stereo_fault(observation) or solve_one(observed_features(observation, with_hub=False), observation.seen)


def joint_hub(observation: Observation) -> Solution | NoFixReason:
    """As `joint`, with the ellipse centres of the hub's edges among the features, each with its own radius.

    The hub lies behind the rim plane, so it tells the sign of the tilt. Without it the answer is that of `joint`, with
    that method's wide covariance, and a note.
    """
    reason = stereo_fault(observation) or hub_fault(observation)
    if reason is not None:
        return reason
    note = hub_note(observation)
    features = observed_features(observation, with_hub=True)
    return solve_one(features, observation.seen, None if note else observation.hub_seen, note)


def hub_note(observation: Observation) -> str:
    """Why an answer rests on the markers alone; empty when the hub was measured."""
    if observation.layout.hub_center_m is None:
        return "the drogue has no hub: the tilt rests on the markers alone"
    return "" if observation.hub_seen.any() else "no hub was measured: the tilt rests on the markers alone"


def solve_one(
    features: Features, used: NDArray[np.bool_], used_hub: NDArray[np.bool_] | None = None, note: str = ""
) -> Solution | NoFixReason:
    """The pose of one frame from its features, if they fit the drogue."""
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
    """Why one frame's features cannot be the drogue's in a pose, or None when they can."""
    predicted = project_features(features, rotation[None], translation_m[None])
    squares = ((predicted - features.measured[:2].transpose(1, 2, 3, 0)) ** 2).sum(axis=-1)[features.seen]
    radius_px = features.camera.fx_px * features.radii_m[0] / translation_m[2]
    miss_px = float(np.sqrt(squares.mean()))
    if miss_px <= max(_LEAST_MISS_PX, _LARGEST_MISS_FRACTION * float(radius_px)):
        return None
    return NoFixReason(f"the markers do not fit the drogue: they miss their places by {miss_px:.1f} px (rms)")


_HUBER = Loss(huber_sigmas=2.0)
# A feature in both eyes has four residuals; chance exceeds this once in 2000.
_LARGEST_CHI2 = 20.0
# Below such a chance residuals are not noise.
_LEAST_CHANCE = 1e-4
# Two features can be told from the rest when at least five more remain.
_LEAST_FOR_TWO_OUT = 7
# Four markers overdetermine the plane that three fix.
_LEAST_INLIERS = 4


def joint_robust(observation: Observation) -> Solution | NoFixReason:
    """Huber's loss first; if any feature then stands out, every set without one or two features is tried.

    The set whose pose explains the features best, each counted up to a limit, tells which are wrong; the answer is that
    of `joint-hub` (or `joint`, where no hub was measured) without them. An edge of the hub counts as a feature.
    """
    reason = stereo_fault(observation) or hub_fault(observation)
    if reason is not None:
        return reason
    features = observed_features(observation, with_hub=True)
    good = _inliers(features)
    count = observation.layout.count
    markers = int((good & _measured_features(features))[:count].sum())
    if not good.all() and markers < _LEAST_INLIERS:
        return NoFixReason(f"only {markers} markers agree with each other, {_LEAST_INLIERS} are needed")
    used, used_hub = observation.seen & good[:count], observation.hub_seen & _hub_inliers(good, count)
    paired = used.all(axis=0)
    if paired.sum() < 3:
        return NoFixReason(f"only {int(paired.sum())} markers that both eyes see agree with each other, 3 are needed")
    note = hub_note(observation)
    if not note and not used_hub.any():
        note = "the hub does not agree with the markers: the tilt rests on the markers alone"
    return solve_one(features.without(~good), used, used_hub if used_hub.any() else None, note)


def _hub_inliers(good: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    return good[count:] if len(good) > count else np.zeros(2, dtype=bool)


def _inliers(features: Features) -> NDArray[np.bool_]:
    """(F,) which features agree with the pose that most of them share; unmeasured ones count as agreeing."""
    found = adjust_both_tilts(features, *two_fold_starts(features), _HUBER)
    best = int(np.argmin(found.costs))
    first = _feature_chi2(features.take(np.zeros(2, dtype=np.int64)), found)[best]
    if (first < _LARGEST_CHI2).all():
        return np.ones(len(first), dtype=bool)
    sets = features.take(np.zeros(2 * len(_leave_out_sets(features)), dtype=np.int64))
    mask = np.repeat(_leave_out_sets(features), 2, axis=0)
    fewer = sets.without(mask)
    starts = two_fold_starts(fewer.take(slice(0, None, 2)))
    tried = adjust(fewer, starts[0].reshape(-1, 3, 3), starts[1].reshape(-1, 3))
    chi2 = np.vstack([_feature_chi2(sets, tried), first])
    scores = np.minimum(chi2, _LARGEST_CHI2).sum(axis=1)
    inliers: NDArray[np.bool_] = chi2[np.argmin(scores)] < _LARGEST_CHI2
    if (inliers & features.is_marker & _measured_features(features)).sum() < _LEAST_INLIERS:
        least = int(np.argmin(np.where(mask, 0.0, chi2[:-1]).sum(axis=1)))
        kept: NDArray[np.bool_] = ~mask[least]
        if _is_consistent(features, kept, chi2[least]):
            return kept
    return inliers


def _is_consistent(features: Features, kept: NDArray[np.bool_], chi2: Array) -> bool:
    """Whether the residuals of the kept features are together no larger than by chance.

    Among four markers, one in 500 is cut off by chance though all are right; their sum then tells.
    """
    freedom = 2 * int(features.seen[0][:, kept].sum()) - 6
    return freedom > 0 and float(chdtrc(freedom, chi2[kept].sum())) > _LEAST_CHANCE


def _leave_out_sets(features: Features) -> NDArray[np.bool_]:
    """(L, F) every choice of one measured feature to leave out, and of two where enough remain."""
    measured = np.flatnonzero(_measured_features(features))
    choices: list[tuple[int, ...]] = [(int(i),) for i in measured]
    if len(measured) >= _LEAST_FOR_TWO_OUT:
        choices += combinations(measured.tolist(), 2)
    mask = np.zeros((len(choices), len(features.points_m)), dtype=bool)
    for row, choice in enumerate(choices):
        mask[row, list(choice)] = True
    return mask


def _feature_chi2(features: Features, adjusted: AdjustedPoses) -> Array:
    """(S, F) squared residuals of every feature in both eyes, in variances; infinite where they are no numbers."""
    state = AdjustmentState(adjusted.rotations, adjusted.translations_m, adjusted.departures)
    size = 2 * features.measured.shape[2] * len(features.points_m)
    residuals = linearise(features, state).residuals[:, :size]
    squares = (residuals.reshape(len(residuals), -1, len(features.points_m)) ** 2).sum(axis=1)
    return np.where(np.isfinite(squares), squares, np.inf)


def _measured_features(features: Features) -> NDArray[np.bool_]:
    """(F,) which features any eye of the first frame measured."""
    seen: NDArray[np.bool_] = features.seen[0].any(axis=0)
    return seen
