"""Rays of one eye in the stage's axes, at any place of a pixel and any time of the exposure."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from datasets_manifest.types.frame import FrameSpec
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import Eye
from render.camera.exposure_motion import pose_polynomial
from render.mitsuba_engine.jit_arrays import jit_array


class CameraRays:
    """Rays of one eye in the stage's axes, through its lens if it has one."""

    def __init__(self, frame: FrameSpec, eye: Eye) -> None:
        self.camera: PinholeCamera = frame.rig.camera
        lens = frame.rig.lens(eye)
        self._slopes = None if lens is None else _corner_slopes(lens)
        self._pose = pose_polynomial(frame, eye)
        self.pose_at_middle = self._pose[0]
        self.moves = bool(np.abs(self._pose[1:]).max() > 0)
        # Plain numbers would become part of the compiled kernel, and every frame would compile its own.
        self._opaque_pose = [
            [[dr.opaque(mi.Float, float(value)) for value in row] for row in coefficient] for coefficient in self._pose
        ]

    def stage_from_eye(self, s: float) -> RigidTransform:
        """Pose at mid-exposure (s = 0) or at one of its ends (-1, 1), where the polynomial is exact."""
        matrix = np.vstack([self._pose[0] + s * (self._pose[1] + s * self._pose[2]), [0.0, 0.0, 0.0, 1.0]])
        return RigidTransform.from_matrix(matrix)

    def rays(self, pixel: Any, place: Any, moment: Any) -> Any:
        """Rays through pixels.

        Args:
            pixel: flat pixel indices.
            place: 2-D place in the pixel's box, (0.5, 0.5) its centre.
            moment: time in the exposure, 0 when the shutter opens and 1 when it closes.
        """
        camera = self.camera
        row = pixel // camera.width_px
        u = mi.Float(pixel - row * camera.width_px) + (place.x - 0.5)
        v = mi.Float(row) + (place.y - 0.5)
        if self._slopes is None:
            slope_x, slope_y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
        else:
            slope_x, slope_y = (self._between_corners(slopes, pixel + row, place) for slopes in self._slopes)
        local = dr.normalize(mi.Vector3f(slope_x, slope_y, mi.Float(1.0)))
        pose = self._pose_at(2.0 * moment - 1.0)
        direction = mi.Vector3f(*[pose[i][0] * local.x + pose[i][1] * local.y + pose[i][2] * local.z for i in range(3)])
        return mi.Ray3f(mi.Point3f(*[pose[i][3] for i in range(3)]), dr.normalize(direction))

    def _between_corners(self, slopes: Any, corner: Any, place: Any) -> Any:
        """Slopes at places of pixels, by their four corners; `corner` is the index of the first of them."""
        low, high = corner, corner + self.camera.width_px + 1
        first, second, third, fourth = (dr.gather(mi.Float, slopes, at) for at in (low, low + 1, high, high + 1))
        return dr.lerp(dr.lerp(first, second, place.x), dr.lerp(third, fourth, place.x), place.y)

    def _pose_at(self, s: Any) -> list[list[Any]]:
        c = self._opaque_pose
        if not self.moves:
            return c[0]
        return [[c[0][i][j] + s * (c[1][i][j] + s * c[2][i][j]) for j in range(4)] for i in range(3)]


def _corner_slopes(lens: Lens) -> tuple[Any, Any]:
    """Slopes x / z and y / z of the rays through the corners of a real eye's pixels, row by row.

    Across one pixel a lens bends them by less than 1e-7 from linear.
    """
    camera = lens.camera
    u, v = np.meshgrid(np.arange(camera.width_px + 1) - 0.5, np.arange(camera.height_px + 1) - 0.5)
    rays = lens.rays(np.stack([u, v], axis=-1)).astype(np.float32)
    return jit_array(mi.Float, rays[..., 0].ravel()), jit_array(mi.Float, rays[..., 1].ravel())
