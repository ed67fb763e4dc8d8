"""Corrects measured centres for lens distortion and rectification, between delivered images and ideal pinhole images.

Centres are measured in the delivered images and then moved to the ideal ones; no image is resampled. Distortion also
shifts the centroid of a disc's image against the image of its centre; the correction uses the disc's size for that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

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
    centers, cov, slopes = _moved(
        lambda places: rig.ideal_px(places, eye), blobs.centers_px, round_shapes, centroids.cov_px2
    )
    areas_px2 = blobs.areas_px2 * np.abs(np.linalg.det(slopes))
    return BinaryCentroids(replace(blobs, centers_px=centers, areas_px2=areas_px2), cov, room_m=centroids.room_m)


def undistort_points(
    rig: StereoRig, eye: Eye, centers_px: Array, shapes_px: Array, cov_px2: Array
) -> tuple[Array, Array]:
    """Move centres of discs from the delivered to the ideal image; as given for a rig without lenses.

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
    return _moved(lambda places: rig.ideal_px(places, eye), centers_px, shapes_px, cov_px2)[:2]


def distort_points(
    rig: StereoRig, eye: Eye, centers_px: Array, shapes_px: Array, cov_px2: Array
) -> tuple[Array, Array]:
    """Move centres of discs from the ideal to the delivered image, the reverse of `undistort_points`."""
    if rig.lenses is None:
        return centers_px, cov_px2
    return _moved(lambda places: rig.real_px(places, eye), centers_px, shapes_px, cov_px2)[:2]


@dataclass(frozen=True, eq=False)
class DeliveredFeatures:
    """What an observation measured, at its places in the delivered images.

    Attributes:
        pixels_px, cov_px2: (2, N, 2) markers of both eyes, and (2, N, 2, 2) covariances.
        hub_px, hub_cov_px2: (2, 2, 2) edges of the hub in both eyes, and (2, 2, 2, 2) covariances.
    """

    pixels_px: Array
    cov_px2: Array
    hub_px: Array
    hub_cov_px2: Array


def distort_observation(observation: Observation) -> DeliveredFeatures:
    """The markers and hub edges of an observation, moved to the delivered images."""
    assert observation.hub_px is not None and observation.hub_cov_px2 is not None
    if observation.rig.lenses is None:
        return DeliveredFeatures(
            observation.pixels_px, observation.cov_px2, observation.hub_px, observation.hub_cov_px2
        )
    layout = observation.layout
    hub_radii_m = np.empty(HUB_EDGES)
    hub_radii_m[[INNER_EDGE, OUTER_EDGE]] = layout.hub_inner_radius_m, layout.hub_outer_radius_m
    markers, hubs = [], []
    for index, eye in enumerate(EYES):
        seen = observation.seen[index]
        px_per_m = _plane_to_image(observation.pixels_px[index, seen], layout.centers_m[seen, :2])
        shapes = np.broadcast_to(layout.radius_m * px_per_m, (layout.count, 2, 2))
        markers.append(
            distort_points(observation.rig, eye, observation.pixels_px[index], shapes, observation.cov_px2[index])
        )
        edges = hub_radii_m[:, None, None] * px_per_m
        hubs.append(
            distort_points(observation.rig, eye, observation.hub_px[index], edges, observation.hub_cov_px2[index])
        )
    (pixels, cov), (hub_pixels, hub_cov) = (
        tuple(np.stack(part) for part in zip(*each, strict=True)) for each in (markers, hubs)
    )
    return DeliveredFeatures(pixels, cov, hub_pixels, hub_cov)


def _plane_to_image(pixels_px: Array, places_m: Array) -> Array:
    """(2, 2) linear map from the markers' plane to the image; 1 px/m where the markers do not determine it. [px/m]"""
    if len(pixels_px) < _LEAST_MARKERS:
        return _LEAST_PX_PER_M * np.eye(2)
    arms_m, arms_px = places_m - places_m.mean(axis=0), pixels_px - pixels_px.mean(axis=0)
    slope: Array = np.linalg.lstsq(arms_m, arms_px, rcond=None)[0].T
    return slope if abs(np.linalg.det(slope)) > _LEAST_PX_PER_M**2 else _LEAST_PX_PER_M * np.eye(2)


def _moved(
    mapping: Callable[[Array], Array], centers_px: Array, shapes_px: Array, cov_px2: Array
) -> tuple[Array, Array, Array]:
    """(M, 2) moved centres, (M, 2, 2) covariances and (M, 2, 2) slopes of the map; NaN where no centre was measured."""
    centers, cov, slopes = centers_px.copy(), cov_px2.copy(), np.full_like(cov_px2, np.nan)
    known = np.isfinite(centers_px).all(axis=1)
    centers[known], slopes[known] = _map_ellipses(mapping, centers_px[known], shapes_px[known])
    cov[known] = slopes[known] @ cov_px2[known] @ slopes[known].transpose(0, 2, 1)
    return centers, cov, slopes


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
