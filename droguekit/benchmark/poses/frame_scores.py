"""One method, pair by pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from droguekit.benchmark.poses.bounds import FeatureNoise, component_deviations
from droguekit.benchmark.poses.centroid_errors import CentroidErrors, position_error_from_centroids
from droguekit.benchmark.poses.consistency import squared_errors
from droguekit.benchmark.poses.flips import flip_trials, ring_tilt_scale
from droguekit.benchmark.poses.frame_truth import DrogueTruth
from droguekit.benchmark.poses.pose_errors import pose_error
from droguekit.benchmark.poses.rangefinder_errors import Depth
from droguekit.benchmark.poses.reference import Reference, bound_covariance, feature_noise
from droguekit.benchmark.poses.summary import FrameScore, PoseScore
from droguekit.benchmark.statistics import root_mean_square
from geometry.se3 import Array


def frame_scores(
    drogues: Mapping[int, DrogueTruth],
    estimates: Mapping[int, Estimate],
    centroids: Mapping[int, CentroidErrors],
    reference: Reference,
) -> dict[int, FrameScore]:
    """Score a method on every pair that shows a drogue.

    Args:
        drogues: the truth by frame.
        estimates: of the method, by frame; one may be missing.
        centroids: of the method, for every frame of `drogues`.
        reference: of the file.
    """
    noise = [
        _used_noise([centroids[i] for i in drogues if reference.bin_of_frame[i] == k])
        for k in range(len(reference.bins))
    ]
    scores = {}
    for index, truth in drogues.items():
        estimate, found = estimates.get(index), centroids[index]
        pose = None
        if isinstance(estimate, PoseEstimate):
            own_noise = noise[reference.bin_of_frame[index]]
            pose = _pose_score(estimate, truth, found, own_noise, reference.covariances[index])
        scores[index] = FrameScore(
            pose=pose,
            bound=reference.bounds[index],
            centroids=found,
            from_centroids_m=position_error_from_centroids(truth, found),
        )
    return scores


def _pose_score(
    estimate: PoseEstimate,
    truth: DrogueTruth,
    centroids: CentroidErrors,
    noise: FeatureNoise | None,
    common: Array | None,
) -> PoseScore:
    pose = estimate.left_from_drogue
    error = pose_error(pose, truth.left_from_drogue)
    own = bound_covariance(truth, _used(truth, centroids), noise)
    covariance = common if own is None else own
    reading_m = truth.rangefinder_reading_m
    scale_rad = None if noise is None else ring_tilt_scale(truth, centroids, noise.marker_px)
    return PoseScore(
        error=error,
        common_bound=None if common is None else component_deviations(truth.left_from_drogue, common),
        own_bound=None if own is None else component_deviations(truth.left_from_drogue, own),
        has_covariance=estimate.covariance is not None,
        squared_errors=squared_errors(estimate, error),
        flips=None if covariance is None else flip_trials(pose, truth, covariance, scale_rad),
        depth=None if reading_m is None else Depth(float(pose.translation_m[2]), truth.distance_m, reading_m),
    )


def _used(truth: DrogueTruth, centroids: CentroidErrors) -> NDArray[np.bool_]:
    used = np.zeros_like(truth.visible)
    used[centroids.eye[centroids.used], centroids.feature[centroids.used]] = True
    return used


def _used_noise(errors: Sequence[CentroidErrors]) -> FeatureNoise | None:
    """Noise of the centroids on which a method's poses rest."""
    offsets = np.concatenate([e.offset_px[e.used] for e in errors])
    hub = np.concatenate([e.is_hub[e.used] for e in errors])
    marker_px, hub_px = (root_mean_square(part) if len(part) else None for part in (offsets[~hub], offsets[hub]))
    return feature_noise(marker_px, hub_px)
