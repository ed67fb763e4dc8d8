"""Boxes, around a drogue's rim among others, and the image's region around one, resampled to a size of its own."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels, StereoImages
from geometry.boxes import intersection_area
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig
from nav.detector.detector import Detection, StereoDetection

_OUTLINE_POINTS = 32
# With less of the box on the image, too few markers are left.
_SMALLEST_VISIBLE_SHARE = 0.5
# Smaller boxes are discarded.
_SMALLEST_SIDE_PX = 3.0


def rim_boxes(rig: StereoRig, rim_radius_m: float, left_from_drogue: RigidTransform) -> StereoDetection:
    """Boxes around the rim in both images; None for an eye whose image shows less than half of the box."""
    outline_m = disc_outline(left_from_drogue, np.zeros(3), rim_radius_m, _OUTLINE_POINTS)
    if not outline_m[:, 2].min() > 0:
        return StereoDetection(None, None)
    return StereoDetection(_detection(rig, outline_m, "left"), _detection(rig, outline_m, "right"))


def _detection(
    rig: StereoRig, outline_m: np.ndarray[tuple[int, ...], np.dtype[np.float64]], eye: Eye
) -> Detection | None:
    points_px = rig.image(outline_m, eye)
    (left, top), (right, bottom) = points_px.min(axis=0).tolist(), points_px.max(axis=0).tolist()
    box = (left, top, right - left, bottom - top)
    size_px = (rig.camera.width_px, rig.camera.height_px)
    inside = intersection_area(box, (-0.5, -0.5, *size_px))
    is_visible = min(box[2:]) >= _SMALLEST_SIDE_PX and inside >= _SMALLEST_VISIBLE_SHARE * box[2] * box[3]
    return Detection(box, 1.0) if is_visible else None


Box = tuple[float, float, float, float]
"""x, y of the low corner, width, height in pixel-centre coordinates. [px]"""

# A pixel of a shrunk region is the mean of at most this many image pixels along each axis; more only cost time.
_AVERAGED = 3
# Up to this reduction, interpolation counts every pixel by at least half along each axis, in a quarter of the time.
_AREA_FROM = 1.5
# 12 bits to 8 by a square root, which makes shot noise uniform and keeps the levels of dark scenes.
_TO_8_BIT: NDArray[np.uint8] = np.round(np.sqrt(np.arange(4096) / 4095) * 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class EyeImage:
    """Image of one eye.

    Attributes:
        pixels: (H, W, 3) or (H, W), as in `StereoImages`.
        time_s: mid-exposure. [s]
    """

    pixels: Pixels
    time_s: float


def eye_image(images: StereoImages, eye: Eye) -> EyeImage:
    """One eye's image of a pair."""
    return EyeImage(images.left if eye == "left" else images.right, images.time_s)


@dataclass(frozen=True, eq=False)
class ImageRegion:
    """A region of an image, resampled to its own grid.

    Attributes:
        pixels: (h, w, C) of 8 bit; C is 3, or 1 of a mono image.
        origin_px: (2,) centre of the first of these pixels in the image. [px]
        step_px: (2,) image pixels from one of them to the next. [px]
    """

    pixels: NDArray[np.uint8]
    origin_px: Array
    step_px: Array

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return int(self.pixels.shape[1]), int(self.pixels.shape[0])

    def to_grid(self, points_px: Array) -> Array:
        """(..., 2) columns and rows in the region of (..., 2) image points."""
        grid_points: Array = (points_px - self.origin_px) / self.step_px
        return grid_points

    def to_image(self, grid_points: Array) -> Array:
        """(..., 2) image points of (..., 2) columns and rows in the region. [px]"""
        points: Array = self.origin_px + grid_points * self.step_px
        return points

    def grey(self) -> NDArray[np.uint8]:
        """(h, w) brightness."""
        if self.pixels.shape[2] == 1:
            return self.pixels[:, :, 0]
        return np.asarray(cv2.cvtColor(self.pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def image_region(image: EyeImage, window: Box, step_px: float) -> ImageRegion | None:
    """The part of a window that lies on the image; None where that is less than three pixels wide or high.

    Args:
        image: of one eye.
        window: the region's outline.
        step_px: image pixels per pixel of the region; below 1 the image is enlarged. [px]
    """
    height, width = image.pixels.shape[:2]
    left, top = max(0, int(np.floor(window[0] + 0.5))), max(0, int(np.floor(window[1] + 0.5)))
    right = min(width, int(np.ceil(window[0] + window[2] + 0.5)))
    bottom = min(height, int(np.ceil(window[1] + window[3] + 0.5)))
    if right - left < 3 or bottom - top < 3:
        return None
    stride = max(1, int(step_px / _AVERAGED))
    part = image.pixels[top:bottom:stride, left:right:stride]
    part_size = np.array([part.shape[1], part.shape[0]])
    size = np.maximum(1, np.round(part_size * stride / step_px)).astype(int)
    shrink_factor = part_size / size
    flags = cv2.INTER_AREA if step_px > _AREA_FROM else cv2.INTER_LINEAR
    pixels = np.asarray(cv2.resize(part, (int(size[0]), int(size[1])), interpolation=flags))
    if pixels.dtype == np.uint16:
        pixels = _TO_8_BIT[np.minimum(pixels, len(_TO_8_BIT) - 1)]
    origin = np.array([left, top]) + (0.5 * shrink_factor - 0.5) * stride
    return ImageRegion(
        pixels.reshape(size[1], size[0], -1).astype(np.uint8, copy=False), origin, shrink_factor * stride
    )


def box_center(box: Box) -> Array:
    """(2,) centre of a box. [px]"""
    return np.array([box[0] + box[2] / 2, box[1] + box[3] / 2])


def box_from_center(center_px: Array, width_px: float, height_px: float) -> Box:
    """The box with a centre and a size."""
    x, y = float(center_px[0]), float(center_px[1])
    return x - width_px / 2, y - height_px / 2, width_px, height_px


def box_size(box: Box) -> float:
    """Side of the square with the area of a box. [px]"""
    return float(np.sqrt(box[2] * box[3]))


def expand_box(box: Box, margin_x_px: float, margin_y_px: float) -> Box:
    """The box, enlarged by a margin on every side."""
    return box[0] - margin_x_px, box[1] - margin_y_px, box[2] + 2 * margin_x_px, box[3] + 2 * margin_y_px


def move_box(box: Box, center_px: Array, scale: float) -> Box:
    """The box, moved to a centre and scaled."""
    return box_from_center(center_px, box[2] * scale, box[3] * scale)
