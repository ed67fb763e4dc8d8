"""The image of a disc in one eye: its ellipse, and the points of its plane that pixel centres see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drogue_models.marker_layout import MarkerLayout
from drogue_models.parts import Part, marker_id
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig

# The extent of so many points is smaller than the curve's by 8e-5 of the radius.
_OUTLINE_POINTS = 256


@dataclass(frozen=True, eq=False)
class DiscInEye:
    """A disc in the frame of the eye that sees it.

    Attributes:
        part: part id of the feature that ends at the disc's edge.
        center_m: (3,) [m]
        normal: (3,) unit vector.
        radius_m: [m]
        camera: the intrinsics of the eye's ideal image.
        lens: the real eye, or None where it is ideal.
    """

    part: int
    center_m: Array
    normal: Array
    radius_m: float
    camera: PinholeCamera
    lens: Lens | None = None

    def rays(self, pixels_px: ArrayLike) -> Array:
        """(..., 3) directions through (..., 2) pixels of the delivered image, scaled to z = 1."""
        return self.camera.rays(pixels_px) if self.lens is None else self.lens.rays(pixels_px)

    def dual_conic(self) -> Array:
        """(3, 3) dual conic D of the image ellipse: lines l touch it where l^T D l = 0.

        Source: `K (r^2 (I - n n^T) - t t^T) K^T`; the circle's own dual conic diag(1, 1, -1), mapped by the
        homography from its plane to the image.
        """
        matrix = self.camera.matrix()
        in_plane = np.eye(3) - np.outer(self.normal, self.normal)
        conic: Array = matrix @ (self.radius_m**2 * in_plane - np.outer(self.center_m, self.center_m)) @ matrix.T
        return conic

    def extent_px(self) -> tuple[float, float, float, float]:
        """Lowest u, lowest v, highest u, highest v of the disc's image. [px]

        Points beyond the field of a lens count as on its edge, outside the image.
        """
        if self.lens is not None:
            return self._extent_through(self.lens)
        d = self.dual_conic() / self.dual_conic()[2, 2]
        center = d[:2, 2]
        half = np.sqrt(center**2 - np.diag(d)[:2])
        low, high = center - half, center + half
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def _extent_through(self, lens: Lens) -> tuple[float, float, float, float]:
        across = np.linalg.svd(self.normal[None])[2][1:]
        angle = 2 * np.pi * np.arange(_OUTLINE_POINTS) / _OUTLINE_POINTS
        edge_m = self.center_m + self.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ across
        image = lens.image_of_rays(edge_m)
        (u_low, v_low), (u_high, v_high) = image.min(axis=0).tolist(), image.max(axis=0).tolist()
        return u_low, v_low, u_high, v_high

    def semi_axes_px(self) -> tuple[float, float]:
        """Longer and shorter semi-axis of the ellipse in the ideal image. [px]"""
        d = self.dual_conic() / self.dual_conic()[2, 2]
        shape = np.outer(d[:2, 2], d[:2, 2]) - d[:2, :2]
        shorter, longer = np.sqrt(np.maximum(np.linalg.eigvalsh(shape), 0.0))
        return float(longer), float(shorter)

    def plane_depth_m(self, pixels_px: ArrayLike) -> Array:
        """(...) planar depth at which rays through (..., 2) pixel coordinates meet the disc's plane. [m]"""
        depth: Array = (self.center_m @ self.normal) / (self.rays(pixels_px) @ self.normal)
        return depth

    def distance_m(self, pixels_px: ArrayLike) -> Array:
        """(...) distance from the disc's centre at which rays through (..., 2) pixels meet its plane. [m]"""
        points = self.rays(pixels_px) * self.plane_depth_m(pixels_px)[..., None]
        distance: Array = np.linalg.norm(points - self.center_m, axis=-1)
        return distance


def marker_discs(layout: MarkerLayout, rig: StereoRig, pose: RigidTransform, eye: Eye) -> list[DiscInEye]:
    """The markers in the drogue's order, in the frame of one eye; `pose` is `left_from_drogue`."""
    centers = pose.apply(layout.centers_m) - rig.eye_offset_m(eye)
    axis = pose.rotation[:, 2]
    return [
        DiscInEye(marker_id(index), center, axis, layout.radius_m, rig.camera, rig.lens(eye))
        for index, center in enumerate(centers)
    ]


def hub_discs(
    layout: MarkerLayout, rig: StereoRig, pose: RigidTransform, eye: Eye
) -> tuple[DiscInEye, DiscInEye] | None:
    """The discs of the hub's outer and inner edge in the frame of one eye, or None without a hub."""
    if layout.hub_center_m is None:
        return None
    center = pose.apply(layout.hub_center_m) - rig.eye_offset_m(eye)
    outer, inner = (
        DiscInEye(int(Part.HUB), center, pose.rotation[:, 2], radius_m, rig.camera, rig.lens(eye))
        for radius_m in (layout.hub_outer_radius_m, layout.hub_inner_radius_m)
    )
    return outer, inner


@dataclass(frozen=True, eq=False)
class PixelWindow:
    """A rectangle of pixels.

    Attributes:
        rows, columns: its position in the image.
        pixels_px: (h, w, 2) coordinates of its pixel centres.
    """

    rows: slice
    columns: slice
    pixels_px: Array


def window_around(disc: DiscInEye, factor: float) -> PixelWindow | None:
    """The pixels of the image around a disc, or None where none of them is on the image.

    Args:
        disc: the disc.
        factor: size of the window over the extent of the disc's image.
    """
    u_low, v_low, u_high, v_high = disc.extent_px()
    columns = _within((u_low + u_high) / 2, factor * (u_high - u_low) / 2, disc.camera.width_px)
    rows = _within((v_low + v_high) / 2, factor * (v_high - v_low) / 2, disc.camera.height_px)
    if not columns or not rows:
        return None
    u, v = np.meshgrid(np.array(columns, dtype=np.float64), np.array(rows, dtype=np.float64))
    return PixelWindow(slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1), np.stack([u, v], axis=-1))


def _within(middle_px: float, reach_px: float, size_px: int) -> range:
    return range(max(int(np.ceil(middle_px - reach_px)), 0), min(int(np.floor(middle_px + reach_px)) + 1, size_px))
