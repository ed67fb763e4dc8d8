"""Methods `joint` and `joint-hub`: the pose that best explains the features in both eyes at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array, RigidTransform
from nav.pose.batched import JointBatch, solve_features
from nav.pose.faults import fault, hub_fault
from nav.pose.features import Features, observed_features
from nav.pose.pose_method import NoFixReason, Observation, PoseMode, Solution
from nav.pose.reprojection import predicted_px

# Matched features miss their places by this share of a marker's own radius only when they are not the drogue's.
_LARGEST_MISS_FRACTION = 0.5
_LEAST_MISS_PX = 3.0


def joint(observation: Observation) -> Solution | NoFixReason:
    """Weighted least squares over all markers in both eyes, from both weak-perspective attitudes.

    See `nav.pose.batched` for what is reported where the markers do not tell which way the drogue is tilted.
    """
    return fault(observation) or solve_one(observed_features(observation, with_hub=False), observation.seen)


def joint_hub(observation: Observation) -> Solution | NoFixReason:
    """As `joint`, with the ellipse centres of the hub's edges among the features, each with its own radius.

    The hub lies behind the rim plane, so it tells the sign of the tilt. Without it the answer is that of `joint`, with
    that method's wide covariance, and a note.
    """
    reason = fault(observation) or hub_fault(observation)
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
    reason = misfit(features, batch.mode_rotations[0, 0], batch.mode_translations_m[0, 0])
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


def misfit(features: Features, rotation: Array, translation_m: Array) -> NoFixReason | None:
    """Why one frame's features cannot be the drogue's in a pose, or None when they can."""
    predicted = predicted_px(features, rotation[None], translation_m[None])
    squares = ((predicted - features.measured[:2].transpose(1, 2, 3, 0)) ** 2).sum(axis=-1)[features.seen]
    radius_px = features.camera.fx_px * features.radii_m[0] / translation_m[2]
    miss_px = float(np.sqrt(squares.mean()))
    if miss_px <= max(_LEAST_MISS_PX, _LARGEST_MISS_FRACTION * float(radius_px)):
        return None
    return NoFixReason(f"the markers do not fit the drogue: they miss their places by {miss_px:.1f} px (rms)")
