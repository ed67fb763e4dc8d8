"""A real eye: lens distortion, and a small rotation from the axes of the rectified rig.

A rotation about the eye's centre and a distortion move pixels regardless of depth. So every pixel of the real image
corresponds to one pixel of the ideal, rectified image with the same ray, and the rest of the rig's geometry is ideal.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform, log_twist, read_only

_BORDER_POINTS = 32
# The field reaches beyond the image by so many times its width and height, the first with which the lens does not fold.
_FIELD_MARGINS = (4.0, 2.0, 1.0, 0.5, 0.25, 0.1, 0.05, 0.025, 0.0125, 0.0)
# Shares of the way from the axis to a point of the border or of the field's edge, for a search for folds.
_SHARES = np.linspace(0.0, 1.0, 64)[:, None, None]


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
        """(..., 2) ideal points of (..., 2) distorted ones, to rounding errors.

        Raises:
            ValueError: a point outside the region where the distortion is invertible.
        """
        from geometry.distortion_loops import undistort_points

        wanted = np.array(places, dtype=np.float64, order="C")
        ideal, are_found = undistort_points(wanted.reshape(-1, 2), *self._model())
        if not are_found:
            raise self.fold_error()
        return ideal.reshape(wanted.shape)

    def slopes(self, places: ArrayLike) -> Array:
        """(..., 2, 2) derivative of `distort` at (..., 2) ideal points."""
        ideal = np.asarray(places, dtype=np.float64)
        slopes: Array = np.stack(self._distort(ideal)[1:], axis=-1).reshape(*ideal.shape, 2)
        return slopes

    def stretch(self, places: ArrayLike) -> Array:
        """(...) area of the distorted image over that of the ideal one at (..., 2) ideal points; 0 on a fold."""
        _, j_xx, j_xy, j_yx, j_yy = self._distort(np.asarray(places, dtype=np.float64))
        determinant: Array = j_xx * j_yy - j_xy * j_yx
        return determinant

    def fold_error(self) -> ValueError:
        """The error of a distortion that maps several points of an image to one."""
        return ValueError(
            f"distortion: {self.coefficients().tolist()} is not invertible over the whole image; make it weaker"
        )

    def _distort(self, p: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Distorted points, and the entries xx, xy, yx, yy of their Jacobian."""
        # The compiler takes a second to load, and rigs without lenses do not need it.
        from geometry.distortion_loops import distort_points

        found = distort_points(np.array(p, order="C").reshape(-1, 2), *self._model()).reshape(*p.shape[:-1], 6)
        return found[..., :2], found[..., 2], found[..., 3], found[..., 4], found[..., 5]

    def _model(self) -> tuple[Array, Array]:
        """(14,) coefficients in OpenCV's order, and (3, 3) homography from the plane across the axis to the sensor."""
        return np.append(self.coefficients(), np.zeros(9)), np.eye(3)


@dataclass(frozen=True)
class OpenCvDistortion(BrownConrady):
    """OpenCV's whole lens model: rational radial distortion, tangential, thin prism, and a tilted sensor.

    Attributes:
        k1, k2, k3: radial, in the numerator.
        k4, k5, k6: radial, in the denominator.
        p1, p2: tangential.
        s1, s2, s3, s4: thin prism, of the second and fourth power of the distance from the axis: s1, s2 along x and s3,
            s4 along y.
        tau_x, tau_y: tilt of the sensor about its axes. [rad]

    Source: OpenCV's documentation of `calib3d`, "Detailed Description".
    """

    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0
    tau_x: float = 0.0
    tau_y: float = 0.0

    def coefficients(self) -> Array:
        """(14,) k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y."""
        return np.array([getattr(self, one.name) for one in fields(self)])

    def _model(self) -> tuple[Array, Array]:
        return self.coefficients(), self._tilt()

    def _tilt(self) -> Array:
        """(3, 3) homography from the plane across the axis to the tilted one."""
        cos_x, sin_x, cos_y, sin_y = np.cos(self.tau_x), np.sin(self.tau_x), np.cos(self.tau_y), np.sin(self.tau_y)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_x, sin_x], [0.0, -sin_x, cos_x]])
        about_y = np.array([[cos_y, 0.0, -sin_y], [0.0, 1.0, 0.0], [sin_y, 0.0, cos_y]])
        turn = about_y @ about_x
        along_axis = np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0.0, 0.0, 1.0]])
        product: Array = along_axis @ turn
        return product


@dataclass(frozen=True, eq=False)
class Lens:
    """One real eye of a rig.

    Attributes:
        camera: intrinsics of the real image.
        distortion: of the lens.
        ideal_from_real: (3, 3) rotation from the real eye's axes to those of the rectified rig.

    Raises:
        ValueError: the distortion is not invertible over the whole image, or a part of the image looks behind the rig.
    """

    camera: PinholeCamera
    distortion: BrownConrady = BrownConrady()
    ideal_from_real: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        # RigidTransform checks that it is a rotation.
        rotation = RigidTransform(read_only(self.ideal_from_real, (3, 3), "ideal_from_real"), np.zeros(3)).rotation
        object.__setattr__(self, "ideal_from_real", rotation)
        ahead = _with_one(_undistorted_grid(self.camera, self.distortion)) @ rotation[2]
        if not (ahead > 0).all():
            turn_deg = np.degrees(np.linalg.norm(log_twist(RigidTransform(rotation, np.zeros(3)))[3:]))
            raise ValueError(
                f"ideal_from_real: must leave the whole image before the rig, got a rotation by {turn_deg:.0f} degrees"
            )

    def rays(self, real_px: ArrayLike) -> Array:
        """(..., 3) directions in the rig's axes through (..., 2) pixels of the real image, scaled to z = 1.

        Raises:
            ValueError: the distortion is not invertible there.
        """
        return self._in_rig(self.distortion.undistort(self.camera.rays(real_px)[..., :2]))

    @cached_property
    def field(self) -> Array:
        """(2, 2) lowest and highest x and y, at z = 1 in the rig's axes, of all rays of the image, with a margin.

        The margin is as wide as the lens is one-to-one, at most four times width and height. Beyond, the polynomial of
        a lens may fold back: there it says nothing about what the eye sees.
        """
        rays = self._in_rig(_undistorted_grid(self.camera, self.distortion))
        low, high = rays[..., :2].min(axis=(0, 1)), rays[..., :2].max(axis=(0, 1))
        for margin in _FIELD_MARGINS:
            field = np.stack([low - margin * (high - low), high + margin * (high - low)])
            if (self._stretch(_with_one(_SHARES * _edge_of(field))) > 0).all():
                break
        field.flags.writeable = False
        bounds: Array = field
        return bounds

    def is_in_field(self, rays: ArrayLike) -> NDArray[np.bool_]:
        """(...) whether (..., 3) rays in the rig's axes, z > 0, lie on the image, or in the margin around it."""
        directions = np.asarray(rays, dtype=np.float64)
        places = directions[..., :2] / directions[..., 2:]
        low, high = self.field
        inside = ((places >= low) & (places <= high)).all(axis=-1)
        # A corner of the field may lie beyond a fold.
        near = _with_one(np.where(inside[..., None], places, 0.0))
        seen: NDArray[np.bool_] = inside & (self._stretch(near) > 0)
        return seen

    def image_of_rays(self, rays: ArrayLike) -> Array:
        """(..., 2) pixels of (..., 3) rays in the rig's axes, z > 0; outside the image for those beyond the field."""
        directions = np.asarray(rays, dtype=np.float64)
        beyond = ~self.is_in_field(directions)
        if not beyond.any():
            return self.project_rays(directions)
        moved, (low, high) = directions.copy(), self.field
        moved[beyond, :2] = np.clip(directions[beyond, :2] / directions[beyond, 2:], low, high)
        moved[beyond, 2] = 1.0
        pixels = self.project_rays(moved)
        # Where a lens folds just behind the border, the field's edge may touch the image.
        inside = beyond & self.camera.contains(pixels)
        pixels[inside] = _out_of_image(self.camera, pixels[inside])
        return pixels

    def largest_shift_px(self, ideal: PinholeCamera) -> float:
        """Largest distance between a place of the image and that of an ideal camera with the same ray. [px]"""
        ideal_px = ideal.project(self._in_rig(_undistorted_grid(self.camera, self.distortion)))
        return float(np.linalg.norm(ideal_px - _grid_px(self.camera), axis=-1).max())

    def pixels_per_sr(self, rays: ArrayLike) -> Array:
        """(...) density of the image's pixels over the solid angle around (..., 3) rays in the rig's axes. [1/sr]"""
        directions = np.asarray(rays, dtype=np.float64)
        along = directions @ self.ideal_from_real[:, 2] / np.linalg.norm(directions, axis=-1)
        density: Array = self.camera.fx_px * self.camera.fy_px * self._stretch(directions) / along**3
        return density

    def _in_rig(self, places: Array) -> Array:
        """(..., 3) directions in the rig's axes, scaled to z = 1, of (..., 2) ideal points at unit distance."""
        turned = np.einsum("ij,...j->...i", self.ideal_from_real, _with_one(places))
        rays: Array = turned / turned[..., 2:]
        return rays

    def _stretch(self, rays: Array) -> Array:
        """(...) the distortion's `stretch` along (..., 3) rays in the rig's axes, 0 for those behind the eye."""
        turned = np.einsum("ji,...j->...i", self.ideal_from_real, rays)
        ahead = turned[..., 2] > 0
        stretch = self.distortion.stretch(turned[..., :2] / np.where(ahead, turned[..., 2], 1.0)[..., None])
        return np.where(ahead, stretch, 0.0)

    def project_rays(self, rays: ArrayLike) -> Array:
        """(..., 2) pixels of the real image of (..., 3) directions in the rig's axes, z > 0. [px]"""
        turned = np.einsum("ji,...j->...i", self.ideal_from_real, np.asarray(rays, dtype=np.float64))
        seen = self.distortion.distort(turned[..., :2] / turned[..., 2:])
        return self.camera.project(_with_one(seen))

    def slopes_of_rays(self, rays: ArrayLike) -> Array:
        """(..., 2, 2) derivative of `project_rays` by x and y of (..., 3) rays scaled to z = 1. [px]"""
        directions = np.asarray(rays, dtype=np.float64)
        real_from_ideal = self.ideal_from_real.T
        turned = np.einsum("ij,...j->...i", real_from_ideal, directions / directions[..., 2:])
        places, depths = turned[..., :2] / turned[..., 2:], turned[..., 2, None, None]
        by_turn = (real_from_ideal[:2, :2] - places[..., None] * real_from_ideal[2, :2]) / depths
        focal_px = np.diag([self.camera.fx_px, self.camera.fy_px])
        slopes: Array = focal_px @ self.distortion.slopes(places) @ by_turn
        return slopes


def _out_of_image(camera: PinholeCamera, pixels: Array) -> Array:
    """(N, 2) pixels of an image, moved away from its principal point until they lie a pixel outside. [px]"""
    center = np.array([camera.cx_px, camera.cy_px])
    away = pixels - center
    ends = np.where(away > 0, np.array([camera.width_px, camera.height_px]) + 0.5, -1.5) - center
    share = np.divide(ends, away, out=np.full_like(away, np.inf), where=away != 0).min(axis=-1, keepdims=True)
    moved: Array = center + share * away
    return moved


def _with_one(places: Array) -> Array:
    """(..., 3) directions of (..., 2) points of the image plane at unit distance."""
    return np.concatenate([places, np.ones_like(places[..., :1])], axis=-1)


def _edge_of(field: Array) -> Array:
    """(M, 2) x and y around the edge of a field."""
    x, y = np.linspace(field[0], field[1], _BORDER_POINTS).T
    return _outline(np.stack(np.meshgrid(x, y), axis=-1))


def _outline(grid: Array) -> Array:
    """(M, 2) the outer points of an (N, N, 2) grid."""
    return np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])


def border_px(camera: PinholeCamera) -> Array:
    """(M, 2) points around the border of an image. [px]"""
    return _outline(_grid_px(camera))


def _grid_px(camera: PinholeCamera) -> Array:
    """(N, N, 2) points evenly spaced over an image, from border to border. [px]"""
    u = np.linspace(-0.5, camera.width_px - 0.5, _BORDER_POINTS)
    v = np.linspace(-0.5, camera.height_px - 0.5, _BORDER_POINTS)
    return np.stack(np.meshgrid(u, v), axis=-1)


# A dataset has one rig, which every record repeats.
@lru_cache(maxsize=64)
def _undistorted_grid(camera: PinholeCamera, distortion: BrownConrady) -> Array:
    """(N, N, 2) ideal points, in the image plane at unit distance, of the grid of an image.

    Raises:
        ValueError: the distortion is not invertible over the whole image.
    """
    grid = distortion.undistort(camera.rays(_grid_px(camera))[..., :2])
    # Points on both sides of a narrow fold are inverted; the fold lies between them.
    if not (distortion.stretch(_SHARES * _outline(grid)) > 0).all():
        raise distortion.fold_error()
    grid.flags.writeable = False
    return grid
