"""The stereo rig: two equal rectified pinholes, the right one `baseline_m` along +x of the left, and optional lenses.

`camera`, `project` and `triangulate` refer to the ideal, rectified images. Where the sensors deliver other images, the
rig has lenses, and `real_px` and `ideal_px` convert between the two.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geometry.distortion import Lens, border_px
from geometry.pinhole import PinholeCamera
from geometry.se3 import FRD_FROM_OPTICAL, Array, RigidTransform, read_only

Eye = Literal["left", "right"]
EYES: tuple[Eye, Eye] = ("left", "right")


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two equal rectified cameras on the receiver.

    Attributes:
        camera: intrinsics of both rectified eyes.
        baseline_m: distance of the right eye from the left, along x.
        body_from_left: left camera frame to the receiver's body axes (forward, right, down).
        probe_tip_body_m: (3,) tip of the refuelling probe in body axes.
        lenses: the real left and right eye, with images of the same size, or None for ideal ones.
    """

    camera: PinholeCamera
    baseline_m: float
    body_from_left: RigidTransform = FRD_FROM_OPTICAL
    probe_tip_body_m: Array = field(default_factory=lambda: np.array([1.0, 0.45, 0.35]))
    lenses: tuple[Lens, Lens] | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.baseline_m) and self.baseline_m > 0):
            raise ValueError(f"baseline_m: must be positive, got {self.baseline_m}")
        object.__setattr__(self, "probe_tip_body_m", read_only(self.probe_tip_body_m, (3,), "probe_tip_body_m"))
        size = (self.camera.width_px, self.camera.height_px)
        for lens in self.lenses or ():
            if (lens.camera.width_px, lens.camera.height_px) != size:
                raise ValueError(
                    f"lenses: images must be {size} px, got {lens.camera.width_px}x{lens.camera.height_px}"
                )

    def eye_offset_m(self, eye: Eye) -> Array:
        """(3,) centre of the eye in the left camera frame. [m]"""
        return np.array([0.0 if eye == "left" else self.baseline_m, 0.0, 0.0])

    def project(self, points_left_m: ArrayLike, eye: Eye) -> Array:
        """(..., 2) image in one eye of (..., 3) points given in the left camera frame. [px]"""
        return self.camera.project(np.asarray(points_left_m, dtype=np.float64) - self.eye_offset_m(eye))

    def lens(self, eye: Eye) -> Lens | None:
        """The real eye, or None where it is ideal."""
        return None if self.lenses is None else self.lenses[EYES.index(eye)]

    def real_px(self, ideal_px: ArrayLike, eye: Eye) -> Array:
        """(..., 2) pixels of the delivered image with the same rays as (..., 2) pixels of the ideal one. [px]"""
        ideal, lens = np.asarray(ideal_px, dtype=np.float64), self.lens(eye)
        return ideal if lens is None else lens.project_rays(self.camera.rays(ideal))

    def real_slopes(self, ideal_px: ArrayLike, eye: Eye) -> Array:
        """(..., 2, 2) derivative of `real_px` at (..., 2) pixels of the ideal image; the identity for an ideal eye."""
        ideal, lens = np.asarray(ideal_px, dtype=np.float64), self.lens(eye)
        if lens is None:
            return np.broadcast_to(np.eye(2), (*ideal.shape, 2))
        slopes: Array = lens.slopes_of_rays(self.camera.rays(ideal)) / [self.camera.fx_px, self.camera.fy_px]
        return slopes

    def ideal_px(self, real_px: ArrayLike, eye: Eye) -> Array:
        """(..., 2) pixels of the ideal image with the same rays as (..., 2) pixels of the delivered one. [px]"""
        return self.camera.project(self.rays(real_px, eye))

    def rays(self, real_px: ArrayLike, eye: Eye) -> Array:
        """(..., 3) directions through (..., 2) pixels of the delivered image, in the rig's axes, scaled to z = 1."""
        lens = self.lens(eye)
        return self.camera.rays(real_px) if lens is None else lens.rays(real_px)

    def image(self, points_left_m: ArrayLike, eye: Eye) -> Array:
        """Projection of points into the delivered image of an eye.

        Args:
            points_left_m: (..., 3) in the left camera frame, in front of the eye. [m]
            eye: which image.

        Returns:
            (..., 2) pixels; beyond a lens's field as of `image_px`. [px]
        """
        return self.image_px(self.project(points_left_m, eye), eye)

    def image_px(self, ideal_px: ArrayLike, eye: Eye) -> Array:
        """(..., 2) places on the delivered image of (..., 2) pixels of the ideal one.

        The polynomial of a lens may fold points back that lie far aside of what the eye sees. So points beyond its
        field (`is_in_field`) are moved to the field's edge, and lie outside the image.
        """
        ideal, lens = np.asarray(ideal_px, dtype=np.float64), self.lens(eye)
        return ideal if lens is None else lens.image_of_rays(self.camera.rays(ideal))

    def is_in_field(self, ideal_px: ArrayLike, eye: Eye) -> NDArray[np.bool_]:
        """(...) whether (..., 2) pixels of the ideal image lie on the delivered one, or in a margin around it.

        There a lens is one-to-one, and `real_px` is what the eye sees. An ideal eye's field has no end.
        """
        lens = self.lens(eye)
        if lens is None:
            return np.ones(np.shape(ideal_px)[:-1], dtype=np.bool_)
        return lens.is_in_field(self.camera.rays(ideal_px))

    def field_px(self, eye: Eye) -> Array:
        """(2, 2) lowest and highest pixels of the ideal image in the field of an eye with a lens. [px]

        Raises:
            ValueError: an ideal eye, whose field has no end.
        """
        lens = self.lens(eye)
        if lens is None:
            raise ValueError(f"eye: the {eye} one has no lens, and no end of its field")
        return self.camera.project(np.column_stack([lens.field, np.ones(2)]))

    @property
    def delivered_focal_px(self) -> float:
        """Focal length of the delivered images: the geometric mean of the axes', and of both eyes the mean. [px]"""
        cameras = [self.camera] if self.lenses is None else [lens.camera for lens in self.lenses]
        return float(np.mean([np.sqrt(camera.fx_px * camera.fy_px) for camera in cameras]))

    def largest_shift_px(self) -> float:
        """Largest displacement by the lenses along the border of an ideal image; 0 for ideal eyes. [px]"""
        if self.lenses is None:
            return 0.0
        border = border_px(self.camera)
        return max(float(np.linalg.norm(self.real_px(border, eye) - border, axis=-1).max()) for eye in EYES)

    def triangulate(self, left_px: ArrayLike, right_px: ArrayLike) -> Array:
        """Maximum-likelihood points for equal isotropic noise in both eyes.

        Args:
            left_px: (..., 2) pixel coordinates.
            right_px: (..., 2) of the same points in the right eye.

        Returns:
            (..., 3) points in the left camera frame; nan where the disparity is not positive. [m]

        Source: the seed paper's eqs. 1 and 2, with the mean of both rows.
        """
        left, right = np.asarray(left_px, dtype=np.float64), np.asarray(right_px, dtype=np.float64)
        c = self.camera
        disparity = left[..., 0] - right[..., 0]
        disparity = np.where(disparity > 0, disparity, np.nan)
        z = c.fx_px * self.baseline_m / disparity
        x = ((left[..., 0] + right[..., 0]) / 2 - c.cx_px) * z / c.fx_px + self.baseline_m / 2
        y = ((left[..., 1] + right[..., 1]) / 2 - c.cy_px) * z / c.fy_px
        return np.stack([x, y, z], axis=-1)

    def common_field_m(self, depth_m: float, radius_m: float) -> tuple[float, float, float, float] | None:
        """Region of the centres of balls that both eyes see whole (to first order, as a disc facing them).

        Args:
            depth_m: Z of the centre. [m]
            radius_m: radius of the ball. [m]

        Returns:
            (x_low, x_high, y_low, y_high) in the left camera frame [m], or None for an empty region.
        """
        c = self.camera
        half_pixel = 0.5
        left_reach = (c.cx_px + half_pixel) / c.fx_px * depth_m
        right_reach = (c.width_px - half_pixel - c.cx_px) / c.fx_px * depth_m
        up_reach = (c.cy_px + half_pixel) / c.fy_px * depth_m
        down_reach = (c.height_px - half_pixel - c.cy_px) / c.fy_px * depth_m
        x_low, x_high = self.baseline_m - left_reach + radius_m, right_reach - radius_m
        y_low, y_high = radius_m - up_reach, down_reach - radius_m
        return None if x_low > x_high or y_low > y_high else (x_low, x_high, y_low, y_high)

    def nearest_full_view_m(self, radius_m: float) -> float:
        """Depth of the nearest facing disc of this radius that both eyes can see whole. [m]"""
        return self.nearest_plate_view_m(2 * radius_m, 2 * radius_m)

    def nearest_plate_view_m(self, width_m: float, height_m: float) -> float:
        """Depth of the nearest facing plate, upright, of this size that both eyes can see whole. [m]"""
        c = self.camera
        return max(height_m * c.fy_px / c.height_px, (width_m + self.baseline_m) * c.fx_px / c.width_px)


def paper_rig() -> StereoRig:
    """The seed paper's rig: 1280x960 pixels of 3.75 um behind 8 mm, baseline 0.12 m (its section 4.2)."""
    focal_px = 8e-3 / 3.75e-6
    return StereoRig(PinholeCamera(1280, 960, focal_px, focal_px, 639.5, 479.5), 0.12)
