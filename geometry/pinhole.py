"""The ideal pinhole camera: x right, y down, z forward; integer pixel coordinates are pixel centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geometry.se3 import Array


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics of one eye.

    Attributes:
        width_px, height_px: size of the image.
        fx_px, fy_px: focal lengths.
        cx_px, cy_px: principal point; (0, 0) is the centre of the top-left pixel.

    Raises:
        ValueError: a size that is no positive whole number, or numbers that are not finite or no focal lengths.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        if not (_is_count(self.width_px) and _is_count(self.height_px)):
            raise ValueError(
                f"width_px, height_px: must be positive whole numbers, got {self.width_px!r} and {self.height_px!r}"
            )
        if not (0 < self.fx_px < np.inf and 0 < self.fy_px < np.inf):
            raise ValueError(f"fx_px, fy_px: must be positive and finite, got {self.fx_px}, {self.fy_px}")
        if not np.isfinite([self.cx_px, self.cy_px]).all():
            raise ValueError(f"cx_px, cy_px: must be finite, got {self.cx_px}, {self.cy_px}")

    def matrix(self) -> Array:
        """(3, 3) intrinsic matrix. [px]"""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def project(self, points_m: ArrayLike) -> Array:
        """Image of points in front of the camera.

        Args:
            points_m: (..., 3) in the camera frame, z > 0.

        Returns:
            (..., 2) pixel coordinates. [px]
        """
        p = np.asarray(points_m, dtype=np.float64)
        pixels = np.empty((*p.shape[:-1], 2))
        pixels[..., 0] = self.fx_px * p[..., 0] / p[..., 2] + self.cx_px
        pixels[..., 1] = self.fy_px * p[..., 1] / p[..., 2] + self.cy_px
        return pixels

    def rays(self, pixels_px: ArrayLike) -> Array:
        """(..., 3) directions through (..., 2) pixel coordinates, scaled to z = 1."""
        p = np.asarray(pixels_px, dtype=np.float64)
        x = (p[..., 0] - self.cx_px) / self.fx_px
        y = (p[..., 1] - self.cy_px) / self.fy_px
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def contains(self, pixels_px: ArrayLike, margin_px: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether (..., 2) pixel coordinates lie on the image, `margin_px` inside its edge."""
        p = np.asarray(pixels_px, dtype=np.float64)
        low = -0.5 + margin_px
        inside: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = (
            (p[..., 0] >= low)
            & (p[..., 1] >= low)
            & (p[..., 0] <= self.width_px - 1 - low)
            & (p[..., 1] <= self.height_px - 1 - low)
        )
        return inside


def _is_count(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 1)
