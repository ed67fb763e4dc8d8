"""Rays of one eye in the drogue frame, at any place of a pixel and any time of the exposure."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from datasets_manifest.frame import FrameSpec
from geometry.pinhole import PinholeCamera
from geometry.stereo import Eye
from render.motion import pose_polynomial


class CameraRays:
    """Rays of one eye in the drogue frame."""

    def __init__(self, frame: FrameSpec, eye: Eye) -> None:
        self.camera: PinholeCamera = frame.rig.camera
        self._pose = pose_polynomial(frame, eye)
        self.pose_at_middle = self._pose[0]
        self.moves = bool(np.abs(self._pose[1:]).max() > 0)
        # Plain numbers would become part of the compiled kernel, and every frame would compile its own.
        self._opaque_pose = [
            [[dr.opaque(mi.Float, float(value)) for value in row] for row in coefficient] for coefficient in self._pose
        ]

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
        local = dr.normalize(
            mi.Vector3f((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, mi.Float(1.0))
        )
        pose = self._pose_at(2.0 * moment - 1.0)
        direction = mi.Vector3f(*[pose[i][0] * local.x + pose[i][1] * local.y + pose[i][2] * local.z for i in range(3)])
        return mi.Ray3f(mi.Point3f(*[pose[i][3] for i in range(3)]), dr.normalize(direction))

    def _pose_at(self, s: Any) -> list[list[Any]]:
        c = self._opaque_pose
        if not self.moves:
            return c[0]
        return [[c[0][i][j] + s * (c[1][i][j] + s * c[2][i][j]) for j in range(4)] for i in range(3)]
