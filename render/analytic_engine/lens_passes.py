"""The pixel centres of a real eye whose rays meet a flat ring."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from geometry.circles import disc_outline
from geometry.distortion import Lens
from geometry.se3 import Array
from render.analytic_engine.flat_parts import FlatRing
from render.analytic_engine.outlines import EyeView

_OUTLINE_POINTS = 128
# Chords of the outline fall short of the circle by 3e-4 of its radius.
_MARGIN_PX = 2


@dataclass(frozen=True, eq=False)
class RingPixels:
    """A window of the image and what of it a ring covers.

    Attributes:
        rows, columns: where the window lies.
        inside: (h, w) whether the ray through a pixel centre meets the ring.
        depth_m: (h, w) planar depth at which it meets the ring's plane. [m]
    """

    rows: slice
    columns: slice
    inside: NDArray[np.bool_]
    depth_m: NDArray[np.float32]


@lru_cache(maxsize=2)
def _pixel_rays(lens: Lens) -> Array:
    """(H, W, 2) x and y at z = 1 of the rays through all pixel centres."""
    u, v = np.meshgrid(np.arange(lens.camera.width_px), np.arange(lens.camera.height_px))
    rays: Array = lens.rays(np.stack([u, v], axis=-1))[..., :2]
    return rays


def lens_ring_pixels(ring: FlatRing, view: EyeView, lens: Lens) -> RingPixels | None:
    """Window around a ring, or None where it lies beside the image."""
    outline_px = view.rig.image(
        disc_outline(view.left_from_drogue, ring.center_m, ring.outer_radius_m, _OUTLINE_POINTS), view.eye
    )
    size = np.array([lens.camera.width_px, lens.camera.height_px])
    low = np.clip(np.floor(outline_px.min(axis=0)).astype(int) - _MARGIN_PX, 0, size)
    high = np.clip(np.ceil(outline_px.max(axis=0)).astype(int) + _MARGIN_PX + 1, 0, size)
    if (low >= high).any():
        return None
    rows, columns = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
    rays = _pixel_rays(lens)[rows, columns]
    center_m, axis = view.center_m(ring), view.left_from_drogue.rotation[:, 2]
    x, y = rays[..., 0], rays[..., 1]
    depth_m = (center_m @ axis) / (x * axis[0] + y * axis[1] + axis[2])
    square_m2 = (x * depth_m - center_m[0]) ** 2 + (y * depth_m - center_m[1]) ** 2 + (depth_m - center_m[2]) ** 2
    inside = (square_m2 <= ring.outer_radius_m**2) & (square_m2 >= ring.inner_radius_m**2)
    return RingPixels(rows, columns, inside, depth_m.astype(np.float32))
