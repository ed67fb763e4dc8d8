"""One method on one dataset, frame by frame: errors of poses and centroids against the records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from droguekit.scoring.poses.centroid_errors import centroid_errors
from droguekit.scoring.poses.drogue_truth import DrogueTruth, drogue_truth
from droguekit.scoring.poses.pose_errors import estimates_by_method, pose_error
from geometry.se3 import Array
from studies.acceptance.rendered.centroid_bounds import center_bounds_px

BEST, CHAIN = "joint-hub", "paper"
"""Our best method, and the seed paper's."""
METHODS = (BEST, CHAIN)
"""Methods that a tier runs."""


@dataclass(frozen=True, eq=False)
class MarkerErrors:
    """Measured minus true centres of the markers of one frame.

    Attributes:
        offset_px: (K, 2).
        outward_px: (K,) part that points away from the drogue's middle.
        bound_px: (K,) smallest standard deviation of a coordinate that the light allows.
    """

    offset_px: Array
    outward_px: Array
    bound_px: Array


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """One frame.

    Attributes:
        distance_m: Z of the rim's centre. [m]
        pose: (5,) X, Y, Z [m], pitch and yaw [deg], estimate minus truth, or None without a pose.
        transverse_m: across the line of sight, 0 without a pose. [m]
        markers: of its centroids.
    """

    distance_m: float
    pose: Array | None
    transverse_m: float
    markers: MarkerErrors


Frames = Mapping[int, FrameErrors]


def score_frames(dataset: Path, estimates: Path, methods: Iterable[str]) -> dict[str, dict[int, FrameErrors]]:
    """Errors of some methods in every frame that shows a drogue.

    Raises:
        ValueError: a dataset or estimates that cannot be read, or a method that is not among them.
    """
    data = Dataset(dataset)
    found = estimates_by_method(read_estimates(estimates), data.frame_indices, str(estimates))
    missing = [name for name in methods if name not in found]
    if missing:
        raise ValueError(f"{estimates}: has no method {missing[0]!r}; there are {', '.join(found)}")
    scores: dict[str, dict[int, FrameErrors]] = {name: {} for name in methods}
    for index in data.frame_indices:
        record = data.record(index)
        truth = drogue_truth(record)
        if truth is None:
            continue
        bounds_px = center_bounds_px(record)
        for name, frames in scores.items():
            estimate = found[name].get(index)
            errors = centroid_errors(truth, estimate.features if estimate is not None else ())
            marker = ~errors.is_hub
            markers = MarkerErrors(
                errors.offset_px[marker],
                errors.outward_px[marker],
                bounds_px[errors.eye[marker], errors.feature[marker]],
            )
            pose, transverse_m = _pose(estimate, truth)
            frames[index] = FrameErrors(truth.distance_m, pose, transverse_m, markers)
    return scores


def _pose(estimate: object, truth: DrogueTruth) -> tuple[Array | None, float]:
    if not isinstance(estimate, PoseEstimate):
        return None, 0.0
    error = pose_error(estimate.left_from_drogue, truth.left_from_drogue)
    return error.components, error.transverse_m


def between_m(frames: Frames, low_m: float, high_m: float) -> dict[int, FrameErrors]:
    """The frames whose distance lies in [low, high], with a hundredth of leeway for stations."""
    return {i: f for i, f in frames.items() if 0.99 * low_m <= f.distance_m <= 1.01 * high_m}


def stacked_px(frames: Frames) -> Array:
    """(K, 2) offsets of all markers. [px]"""
    return np.concatenate([np.zeros((0, 2)), *(frame.markers.offset_px for frame in frames.values())])


def pose_array(frames: Frames) -> Array:
    """(n, 5) errors of the frames with a pose. [m, deg]"""
    poses = [frame.pose for frame in frames.values() if frame.pose is not None]
    return np.array(poses, dtype=np.float64).reshape(-1, 5)
