"""Corrects measured centres for lens distortion and rectification, between delivered images and ideal pinhole images.

Centres are measured in the delivered images and then moved to the ideal ones; no image is resampled. Distortion also
shifts the centroid of a disc's image against the image of its centre; the correction uses the disc's size for that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig
from nav.centroids.binary_centroids import BinaryCentroids
from nav.pose.pose_method import HUB_EDGES, INNER_EDGE, OUTER_EDGE, Observation

_OUTLINE_POINTS = 32
# Fewer markers, or markers on a line, do not tell the shape of their images.
_LEAST_MARKERS = 3
_LEAST_PX_PER_M = 1.0


def undistort_centroids(centroids: BinaryCentroids, rig: StereoRig, eye: Eye) -> BinaryCentroids:
    """Centroids of a delivered image moved to the ideal image; unchanged for a rig without lenses."""
    if rig.lenses is None:
        return centroids
    blobs = centroids.blobs
    round_shapes = blobs.radii_px[:, None, None] * np.eye(2)
    centers, cov = undistort_points(rig, eye, blobs.centers_px, round_shapes, centroids.cov_px2)
    return BinaryCentroids(replace(blobs, centers_px=centers), cov, room_m=centroids.room_m)


def undistort_points(
    rig: StereoRig, eye: Eye, centers_px: Array, shapes_px: Array, cov_px2: Array
) -> tuple[Array, Array]:
    """Move centres of discs from the delivered to the ideal image.

    Args:
        rig, eye: which eye.
        centers_px: (M, 2) measured in the delivered image, NaN where none was measured. [px]
        shapes_px: (M, 2, 2) of the discs' images, as in `nav.centroids.ellipses`. [px]
        cov_px2: (M, 2, 2) covariances of the centres.

    Returns:
        (M, 2) centres and (M, 2, 2) covariances.
    """
    if rig.lenses is None:
        return centers_px, cov_px2
    centers, cov = centers_px.copy(), cov_px2.copy()
    known = np.isfinite(centers_px).all(axis=1)
    moved, slopes = _map_ellipses(lambda places: rig.ideal_px(places, eye), centers_px[known], shapes_px[known])
    centers[known] = moved
    cov[known] = slopes @ cov_px2[known] @ slopes.transpose(0, 2, 1)
    return centers, cov


def distort_points(rig: StereoRig, eye: Eye, centers_px: Array, shapes_px: Array) -> Array:
    """Move (M, 2) centres of discs from the ideal to the delivered image; NaN stays NaN. [px]"""
    if rig.lenses is None:
        return centers_px
    centers = centers_px.copy()
    known = np.isfinite(centers_px).all(axis=1)
    centers[known], _ = _map_ellipses(lambda places: rig.real_px(places, eye), centers_px[known], shapes_px[known])
    return centers


def distort_observation(observation: Observation) -> tuple[Array, Array]:
    """(2, N, 2) markers and (2, 2, 2) hub edges of an observation, moved to the delivered images. [px]"""
    assert observation.hub_px is not None
    if observation.rig.lenses is None:
        return observation.pixels_px, observation.hub_px
    layout = observation.layout
    hub_radii_m = np.empty(HUB_EDGES)
    hub_radii_m[[INNER_EDGE, OUTER_EDGE]] = layout.hub_inner_radius_m, layout.hub_outer_radius_m
    markers, hubs = [], []
    for index, eye in enumerate(EYES):
        seen = observation.seen[index]
        px_per_m = _plane_to_image(observation.pixels_px[index, seen], layout.centers_m[seen, :2])
        shapes = np.broadcast_to(layout.radius_m * px_per_m, (layout.count, 2, 2))
        markers.append(distort_points(observation.rig, eye, observation.pixels_px[index], shapes))
        hubs.append(
            distort_points(observation.rig, eye, observation.hub_px[index], hub_radii_m[:, None, None] * px_per_m)
        )
    return np.stack(markers), np.stack(hubs)


def _plane_to_image(pixels_px: Array, places_m: Array) -> Array:
    """(2, 2) linear map from the markers' plane to the image; 1 px/m where the markers do not determine it. [px/m]"""
    if len(pixels_px) < _LEAST_MARKERS:
        return _LEAST_PX_PER_M * np.eye(2)
    arms_m, arms_px = places_m - places_m.mean(axis=0), pixels_px - pixels_px.mean(axis=0)
    slope: Array = np.linalg.lstsq(arms_m, arms_px, rcond=None)[0].T
    return slope if abs(np.linalg.det(slope)) > _LEAST_PX_PER_M**2 else _LEAST_PX_PER_M * np.eye(2)


def _map_ellipses(mapping: Callable[[Array], Array], centers_px: Array, shapes_px: Array) -> tuple[Array, Array]:
    """(M, 2) centroids of the mapped ellipses, and (M, 2, 2) derivatives of the mapping there."""
    angle = 2 * np.pi * np.arange(_OUTLINE_POINTS) / _OUTLINE_POINTS
    spokes = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    corners = mapping(centers_px[:, None] + np.einsum("mij,kj->mki", shapes_px, spokes))
    origin = corners.mean(axis=1, keepdims=True)
    start = corners - origin
    end = np.roll(start, -1, axis=1)
    cross = start[..., 0] * end[..., 1] - start[..., 1] * end[..., 0]
    offset = ((start + end) * cross[..., None]).sum(axis=1) / (3.0 * cross.sum(axis=1))[:, None]
    slopes = 2.0 / _OUTLINE_POINTS * np.einsum("mki,kj->mij", start, spokes) @ np.linalg.inv(shapes_px)
    return origin[:, 0] + offset, slopes
