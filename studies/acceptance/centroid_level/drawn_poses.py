"""Poses drawn by the protocol's law, and where the drogue's features then stand in both images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.circles import ellipse_center_points
from geometry.se3 import Array
from geometry.stereo import EYES, StereoRig

# The protocol: pitch and yaw within 10 degrees, roll within half of the spacing of eight markers.
TILT_DEG = 10.0
ROLL_DEG = 22.5


@dataclass(frozen=True, eq=False)
class Poses:
    """Many `left_from_drogue`.

    Attributes:
        rotations: (n, 3, 3).
        translations_m: (n, 3).
    """

    rotations: Array
    translations_m: Array


@dataclass(frozen=True, eq=False)
class RightEyeErrors:
    """How the right camera departs from the calibration in each draw.

    Attributes:
        yaw_rad: (n,) turn about the vertical axis, to the right.
        cx_px: (n,) shift of the principal point.
    """

    yaw_rad: Array
    cx_px: Array


def draw_poses(
    rng: np.random.Generator, rig: StereoRig, rim_radius_m: float, distance_m: tuple[float, float], count: int
) -> Poses:
    """Poses uniform in distance, attitude, and place in the common field of view.

    Args:
        rng: the stream.
        rig: the cameras.
        rim_radius_m: of the drogue, all of which both eyes see. [m]
        distance_m: nearest and farthest.
        count: how many.

    Raises:
        ValueError: nearer than the whole drogue fits into both views.
    """
    low, high = distance_m
    if low < rig.nearest_full_view_m(rim_radius_m):
        raise ValueError(f"distance: the whole drogue does not fit into both views at {low:g} m")
    unit = rng.random((count, 6))
    depths = low + (high - low) * unit[:, 0]
    fields = np.array([rig.common_field_m(float(depth), rim_radius_m) for depth in depths], dtype=np.float64)
    x = fields[:, 0] + unit[:, 1] * (fields[:, 1] - fields[:, 0])
    y = fields[:, 2] + unit[:, 2] * (fields[:, 3] - fields[:, 2])
    angles = (2 * unit[:, 3:] - 1) * np.array([TILT_DEG, TILT_DEG, ROLL_DEG])
    rotations = Rotation.from_euler("YXZ", angles, degrees=True).as_matrix()
    return Poses(rotations, np.stack([x, y, depths], axis=-1))


def ellipse_centers_px(
    rig: StereoRig, poses: Poses, centers_m: Array, radii_m: Array, right: RightEyeErrors | None = None
) -> Array:
    """Centres of the image ellipses of discs that face along the drogue's axis.

    Args:
        rig: the cameras.
        poses: of the drogue.
        centers_m: (F, 3) or (n, F, 3) centres in the drogue frame.
        radii_m: (F,).
        right: how the right camera departs from `rig`, None for not at all.

    Returns:
        (n, 2, F, 2) left before right. [px]
    """
    points = np.einsum(
        "nij,...nfj->nfi", poses.rotations, np.broadcast_to(centers_m, (len(poses.rotations), *centers_m.shape[-2:]))
    )
    points = points + poses.translations_m[:, None]
    axes = np.broadcast_to(poses.rotations[:, None, :, 2], points.shape)
    images = []
    for eye in EYES:
        seen, normals = points - rig.eye_offset_m(eye), axes
        if right is not None and eye == "right":
            turn = Rotation.from_rotvec(np.outer(-right.yaw_rad, [0.0, 1.0, 0.0])).as_matrix()
            seen, normals = np.einsum("nij,nfj->nfi", turn, seen), np.einsum("nij,nfj->nfi", turn, normals)
        pixels = rig.camera.project(ellipse_center_points(seen, normals, radii_m))
        if right is not None and eye == "right":
            pixels = pixels + np.stack([right.cx_px, np.zeros_like(right.cx_px)], axis=-1)[:, None]
        images.append(pixels)
    return np.stack(images, axis=1)
