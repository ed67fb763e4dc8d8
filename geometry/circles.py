"""The perspective image of a disc, whose centre differs from the image of the disc's centre."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig

# Evenly spaced on a circle, so that the polygon has the same centre.
_OUTLINE_POINTS = 256


def ellipse_center_points(centers_m: ArrayLike, normals: ArrayLike, radii_m: ArrayLike) -> Array:
    """Virtual points whose ordinary projection is the centre of the image ellipse of a disc.

    Args:
        centers_m: (..., 3) disc centres in the frame of the eye that sees them. [m]
        normals: (..., 3) unit normals in the same frame (either sign).
        radii_m: (...) radii. [m]

    Returns:
        (..., 3) points `t - (r^2 / t_z) (e_z - n_z n)`. [m]

    Source: the centre of the dual conic of the image; it agrees with the conic to 1e-13 px.
    """
    t = np.asarray(centers_m, dtype=np.float64)
    n = np.asarray(normals, dtype=np.float64)
    r = np.asarray(radii_m, dtype=np.float64)
    shift = np.array([0.0, 0.0, 1.0]) - n[..., 2:] * n
    virtual: Array = t - (r**2 / t[..., 2])[..., None] * shift
    return virtual


def project_disc_centers(
    rig: StereoRig, left_from_drogue: RigidTransform, centers_drogue_m: ArrayLike, radii_m: ArrayLike, eye: Eye
) -> Array:
    """Centres of the image ellipses of discs that face along the drogue's axis.

    Args:
        rig: the stereo rig.
        left_from_drogue: pose of the drogue in the left camera.
        centers_drogue_m: (N, 3) disc centres in the drogue frame. [m]
        radii_m: (N,) radii. [m]
        eye: which image.

    Returns:
        (N, 2) pixel coordinates. [px]
    """
    centers = left_from_drogue.apply(centers_drogue_m) - rig.eye_offset_m(eye)
    normals = np.broadcast_to(left_from_drogue.rotation[:, 2], centers.shape)
    return rig.camera.project(ellipse_center_points(centers, normals, radii_m))


def disc_image_centers(
    rig: StereoRig, left_from_drogue: RigidTransform, centers_drogue_m: ArrayLike, radii_m: ArrayLike, eye: Eye
) -> Array:
    """Centroids of the areas that discs cover in the delivered image; arguments as `project_disc_centers`.

    In an ideal eye they are the centres of the image ellipses. Behind a distorting lens the image of a disc is not an
    ellipse; its centroid is that of a polygon through its edge. A disc that reaches beyond the lens's field gets the
    image of its own centre.

    Returns:
        (N, 2) pixel coordinates. [px]
    """
    if rig.lens(eye) is None:
        return project_disc_centers(rig, left_from_drogue, centers_drogue_m, radii_m, eye)
    centers, radii = np.atleast_2d(centers_drogue_m), np.atleast_1d(radii_m)
    if len(centers) != len(radii):
        raise ValueError(f"radii_m: {len(radii)} for {len(centers)} discs")
    outlines = disc_outline(left_from_drogue, centers, radii, _OUTLINE_POINTS)
    images = [
        _polygon_centroid(rig.image(outline, eye))
        if rig.is_in_field(rig.project(outline, eye), eye).all()
        else rig.image(left_from_drogue.apply(center), eye)
        for center, outline in zip(centers, outlines, strict=True)
    ]
    return np.reshape(images, (len(centers), 2))


def _polygon_centroid(corners: Array) -> Array:
    """(2,) centroid of a polygon with (M, 2) corners."""
    origin = corners.mean(axis=0)
    start = corners - origin
    end = np.roll(start, -1, axis=0)
    cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
    center: Array = origin + ((start + end) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    return center


def disc_outline(
    left_from_drogue: RigidTransform, centers_drogue_m: ArrayLike, radii_m: ArrayLike, count: int
) -> Array:
    """Points evenly spaced on the edges of discs across the drogue's axis, in the left camera.

    Args:
        left_from_drogue: the drogue's pose.
        centers_drogue_m: (..., 3) centres of the discs. [m]
        radii_m: (...) their radii. [m]
        count: number of points on each.

    Returns:
        (..., count, 3) points. [m]
    """
    edges = _unit_circle(count) * np.asarray(radii_m, dtype=np.float64)[..., None, None]
    return left_from_drogue.apply(np.asarray(centers_drogue_m, dtype=np.float64)[..., None, :] + edges)


@cache
def _unit_circle(count: int) -> Array:
    """(count, 3) points evenly spaced on a circle of radius one across the third axis."""
    angle = 2 * np.pi * np.arange(count) / count
    circle: Array = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1)
    circle.flags.writeable = False
    return circle


def disc_area_px2(
    rig: StereoRig, left_from_drogue: RigidTransform, center_drogue_m: ArrayLike, radius_m: float, eye: Eye
) -> float:
    """Area of the image of a disc across the drogue's axis. [px^2]

    Source: exact, area of the image ellipse `pi f^2 r^2 |t.n| / (t_z^2 - r^2 (1 - n_z^2))^(3/2)`.
    """
    t = left_from_drogue.apply(center_drogue_m) - rig.eye_offset_m(eye)
    n = left_from_drogue.rotation[:, 2]
    focal2 = rig.camera.fx_px * rig.camera.fy_px
    denominator = (t[2] ** 2 - radius_m**2 * (1 - n[2] ** 2)) ** 1.5
    return float(np.pi * focal2 * radius_m**2 * abs(t @ n) / denominator)
