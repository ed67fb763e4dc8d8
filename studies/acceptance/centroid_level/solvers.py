"""Pose methods on many drawn frames: batched where navigation has a batched solver, frame by frame otherwise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from geometry.stereo import StereoRig
from nav.pose.features import Features, stack_features
from nav.pose.joint import adjust_both_tilts, solve_joint_batch
from nav.pose.method_registry import pose_method
from nav.pose.pose_method import EXACT, NoFixReason, Observation, StatedTolerances
from nav.pose.tilt_pairs import two_fold_starts
from studies.acceptance.centroid_level.drawn_frames import Poses

BATCHED = ("joint", "joint-hub")


@dataclass(frozen=True, eq=False)
class MeasuredFrames:
    """Measured centres of many frames.

    Attributes:
        rig, layout: as the estimator knows them.
        markers_px: (n, 2, N, 2).
        hub_px: (n, 2, 2) centres of the hub's outer edge, or None where no hub is measured.
        sigma_px, hub_sigma_px: standard deviations that are stated to the estimator.
        tolerances: that are stated to the estimator.
    """

    rig: StereoRig
    layout: MarkerLayout
    markers_px: Array
    hub_px: Array | None
    sigma_px: float
    hub_sigma_px: float
    tolerances: StatedTolerances = EXACT


@dataclass(frozen=True, eq=False)
class SolvedFrames:
    """Poses that a method found in many frames.

    Attributes:
        poses: n of them; meaningless where `fixed` is False.
        best: the pose with the smallest residuals, where the method reports a mean over several or weighs them by what
            is likely; the flip law is about these.
        covariances: (n, 6, 6), or None for a method without.
        fixed: (n,) which have a pose.
    """

    poses: Poses
    best: Poses
    covariances: Array | None
    fixed: NDArray[np.bool_]


def solve(method: str, measured: MeasuredFrames) -> SolvedFrames:
    """Poses of all frames by one method.

    Raises:
        ValueError: a method that does not exist.
    """
    return _batched(method, measured) if method in BATCHED else _one_by_one(method, measured)


def hub_edges(measured: MeasuredFrames) -> tuple[Array, Array]:
    """Pixels (n, 2, 2, 2) and covariances (2, 2, 2, 2) of the hub's edges, of which only the outer one is measured.

    A single edge keeps the noise of the hub one number, as it is in the bound.
    """
    assert measured.hub_px is not None
    pixels = np.full((len(measured.hub_px), 2, 2, 2), np.nan)
    pixels[:, :, 1] = measured.hub_px
    return pixels, np.broadcast_to(np.eye(2) * measured.hub_sigma_px**2, (2, 2, 2, 2))


def observations(measured: MeasuredFrames) -> list[Observation]:
    """Every frame as pose methods take it."""
    cov = np.broadcast_to(np.eye(2) * measured.sigma_px**2, (2, measured.layout.count, 2, 2))
    hub, hub_cov = (None, None) if measured.hub_px is None else hub_edges(measured)
    return [
        Observation(
            measured.rig,
            measured.layout,
            pixels,
            cov,
            None if hub is None else hub[index],
            hub_cov,
            measured.tolerances,
        )
        for index, pixels in enumerate(measured.markers_px)
    ]


def _batched(method: str, measured: MeasuredFrames) -> SolvedFrames:
    pixels = measured.markers_px
    cov = np.broadcast_to(np.eye(2) * measured.sigma_px**2, (2, measured.layout.count, 2, 2))
    if method == "joint-hub":
        hub, hub_cov = hub_edges(measured)
        pixels, cov = np.concatenate([pixels, hub], axis=2), np.concatenate([cov, hub_cov], axis=1)
    found = solve_joint_batch(measured.rig, measured.layout, pixels, cov, measured.tolerances)
    features = stack_features(measured.rig, measured.layout, pixels, cov, measured.tolerances)
    return SolvedFrames(Poses(found.rotations, found.translations_m), _best(features), found.covariances, found.sound)


def _best(features: Features) -> Poses:
    """Of the two poses that both starts lead to, the one with the smaller residuals."""
    both = adjust_both_tilts(features, *two_fold_starts(features))
    chosen = 2 * np.arange(features.frames) + both.costs.reshape(-1, 2).argmin(axis=1)
    return Poses(both.rotations[chosen], both.translations_m[chosen])


def _one_by_one(method: str, measured: MeasuredFrames) -> SolvedFrames:
    solver = pose_method(method)
    count = len(measured.markers_px)
    rotations, places = np.broadcast_to(np.eye(3), (count, 3, 3)).copy(), np.zeros((count, 3))
    covariances, fixed, known = np.zeros((count, 6, 6)), np.zeros(count, dtype=np.bool_), True
    for index, observation in enumerate(observations(measured)):
        solution = solver(observation)
        if isinstance(solution, NoFixReason):
            continue
        fixed[index] = True
        rotations[index] = solution.left_from_drogue.rotation
        places[index] = solution.left_from_drogue.translation_m
        if solution.covariance is None:
            known = False
        else:
            covariances[index] = solution.covariance
    poses = Poses(rotations, places)
    return SolvedFrames(poses, poses, covariances if known else None, fixed)
