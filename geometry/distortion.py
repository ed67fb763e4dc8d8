"""A real eye: lens distortion, and a small rotation from the axes of the rectified rig.

A rotation about the eye's centre and a distortion move pixels regardless of depth. So every pixel of the real image
corresponds to one pixel of the ideal, rectified image with the same ray, and the rest of the rig's geometry is ideal.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform, read_only

_MAX_STEPS = 30
_TOLERANCE = 1e-13
_BORDER_POINTS = 32


@dataclass(frozen=True)
class BrownConrady:
    """Radial and tangential distortion, with OpenCV's names and order of coefficients.

    Attributes:
        k1, k2, k3: radial, of the second, fourth and sixth power of the distance from the axis.
        p1, p2: tangential.

    Source: Brown 1971, "Close-range camera calibration"; OpenCV's documentation of `calib3d`.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self.coefficients()).all():
            raise ValueError(f"distortion: must be finite, got {self.coefficients().tolist()}")

    def coefficients(self) -> Array:
        """(5,) k1, k2, p1, p2, k3."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def distort(self, places: ArrayLike) -> Array:
        """(..., 2) distorted points of (..., 2) ideal points, both in the image plane at unit distance."""
        return self._distort(np.asarray(places, dtype=np.float64))[0]

    def undistort(self, places: ArrayLike) -> Array:
        """(..., 2) ideal points of (..., 2) distorted ones, by Newton's method to rounding errors.

        Raises:
            ValueError: a point outside the region where the distortion is invertible.
        """
        wanted = np.asarray(places, dtype=np.float64)
        ideal = wanted.copy()
        for _ in range(_MAX_STEPS):
            seen, j_xx, j_xy, j_yy = self._distort(ideal)
            error = wanted - seen
            if np.abs(error).max(initial=0.0) < _TOLERANCE:
                return ideal
            determinant = j_xx * j_yy - j_xy**2
            if not (determinant > 0).all():
                break
            ideal[..., 0] += (j_yy * error[..., 0] - j_xy * error[..., 1]) / determinant
            ideal[..., 1] += (j_xx * error[..., 1] - j_xy * error[..., 0]) / determinant
        raise ValueError(
            f"distortion: {self.coefficients().tolist()} is not invertible over the whole image; make it weaker"
        )

    def _distort(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """Distorted points, and the entries xx, xy, yy of their symmetric Jacobian."""
        x, y = p[..., 0], p[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        slope = self.k1 + r2 * (2.0 * self.k2 + r2 * 3.0 * self.k3)
        seen = np.stack(
            [
                x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
                y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )
        j_xx = radial + 2.0 * x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x
        j_xy = 2.0 * x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y
        j_yy = radial + 2.0 * y * y * slope + 6.0 * self.p1 * y + 2.0 * self.p2 * x
        return seen, j_xx, j_xy, j_yy


@dataclass(frozen=True, eq=False)
class Lens:
    """One real eye of a rig.

    Attributes:
        camera: intrinsics of the real image.
        distortion: of the lens.
        ideal_from_real: (3, 3) rotation from the real eye's axes to those of the rectified rig.
    """

    camera: PinholeCamera
    distortion: BrownConrady = BrownConrady()
    ideal_from_real: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        # RigidTransform checks that it is a rotation.
        rotation = RigidTransform(read_only(self.ideal_from_real, (3, 3), "ideal_from_real"), np.zeros(3)).rotation
        object.__setattr__(self, "ideal_from_real", rotation)
        self.rays(border_px(self.camera))

    def rays(self, real_px: ArrayLike) -> Array:
        """(..., 3) directions in the rig's axes through (..., 2) pixels of the real image, scaled to z = 1.

        Raises:
            ValueError: the distortion is not invertible there.
        """
        seen = self.camera.rays(real_px)
        seen[..., :2] = self.distortion.undistort(seen[..., :2])
        turned = np.einsum("ij,...j->...i", self.ideal_from_real, seen)
        rays: Array = turned / turned[..., 2:]
        return rays

    def project_rays(self, rays: ArrayLike) -> Array:
        """(..., 2) pixels of the real image of (..., 3) directions in the rig's axes, z > 0. [px]"""
        turned = np.einsum("ji,...j->...i", self.ideal_from_real, np.asarray(rays, dtype=np.float64))
        seen = self.distortion.distort(turned[..., :2] / turned[..., 2:])
        return self.camera.project(np.concatenate([seen, np.ones_like(seen[..., :1])], axis=-1))


def border_px(camera: PinholeCamera) -> Array:
    """(M, 2) points around the border of an image. [px]"""
    u = np.linspace(-0.5, camera.width_px - 0.5, _BORDER_POINTS)
    v = np.linspace(-0.5, camera.height_px - 0.5, _BORDER_POINTS)
    ends_u, ends_v = np.repeat(u[[0, -1]], _BORDER_POINTS), np.repeat(v[[0, -1]], _BORDER_POINTS)
    return np.stack([np.concatenate([u, u, ends_u]), np.concatenate([ends_v, v, v])], axis=-1)
