"""The marker channel of both eyes at the sites where the sensor measured it, cut to the region of the outlines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels, StereoImages
from geometry.stereo import EYES, Eye
from nav.centroids.ellipses import Ellipses
from nav.matching.marker_channel import PLAIN, color_difference, marker_channel
from nav.numerics.compiled import Array32
from nav.numerics.eye_threads import map_eyes

# Margin around an outline: half the motion of up to 30 px while the shutter is open, the window, and the error of an
# initial centre. [px]
_MARGIN_PX = 20
# Pixels up to this distance outside the edge are used; a plain picture needs more of them for its background. [px]
OUTER_DIFFERENCE_PX, _OUTER_PLAIN_PX = 2.5, 5.0
# First site of each colour in an RGGB cell, as row and column.
_FIRST_SITE = ((0, 0), (0, 1), (1, 1))
_GREEN = 1
# Where the other two colours lie around a red or a blue site (beside it, across the corners), and around a green one.
_CROSS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
_CORNERS = np.array([[1, 0, 1], [0, 0, 0], [1, 0, 1]], np.float32) / 4
_ROW = np.array([[0, 0, 0], [1, 0, 1], [0, 0, 0]], np.float32) / 2
_NEIGHBOURS = ((_CROSS, _CORNERS), (_ROW, _ROW.T.copy()))


@dataclass(frozen=True, eq=False)
class MarkerSignal:
    """Part of one image.

    Attributes:
        values: (H, W) linear signal; a difference may be negative.
        clipped: (H, W) pixels at the upper end of the sensor's range.
        first_px: x and y of the first site in the image. [px]
        pitch_px: distance of neighbouring sites; 2 for one colour of a mosaic. [px]
        is_difference: whether it is a colour minus the others, dark beside the markers, or a plain picture.
        own: (H, W) the colour of a difference before the subtraction, up to a constant, None where not available.
    """

    values: Array32
    clipped: NDArray[np.bool_]
    first_px: tuple[float, float]
    pitch_px: int
    is_difference: bool
    own: Pixels | None = None

    @property
    def outer_px(self) -> float:
        """Distance outside an edge up to which pixels are used. [px]"""
        return OUTER_DIFFERENCE_PX if self.is_difference else _OUTER_PLAIN_PX

    @property
    def beside_px(self) -> float:
        """Distance from a site at which light enters its value: a mosaic measures the other colours beside it. [px]"""
        return float(self.pitch_px - 1)

    @property
    def shows_glare(self) -> bool:
        """Whether the signal contains light of a bright sky that the lens or other sites spread over a dark face.

        A difference of colours measured at the same place removes all of it but its colour. A plain picture contains
        all of it. In a mosaic's difference, whose colours lie side by side, sites along the rim get it with any sign.
        """
        return not self.is_difference or self.beside_px > 0


def marker_signals(
    images: StereoImages, color: int | None, ellipses: Ellipses, others_weight: float = PLAIN
) -> tuple[MarkerSignal, MarkerSignal]:
    """Signals of the left and the right eye around the given outlines.

    From a mosaic only the sites of the markers' colour are used, with the means of their neighbours for the other two
    colours; interpolation between sites would move the edges of discs of a few pixels.

    Args:
        images: the pair.
        color: see `nav.matching.marker_channel.marker_color`.
        ellipses: the outlines; they may reach beyond the image.
        others_weight: see `nav.matching.marker_channel.marker_channel`.
    """
    windows = {eye: _window(ellipses.take(ellipses.eyes == index), images.size_px) for index, eye in enumerate(EYES)}

    def signal_of(eye: Eye) -> MarkerSignal:
        window = windows[eye]
        mosaic = images.left_mosaic if eye == "left" else images.right_mosaic
        if color is not None and mosaic is not None:
            return _mosaic_signal(images, mosaic, window, (color, others_weight))
        return _image_signal(images, eye, window, (color, others_weight))

    areas_px2 = ((right - left) * (bottom - top) for left, top, right, bottom in windows.values())
    signals = map_eyes(signal_of, EYES, max(areas_px2))
    return signals["left"], signals["right"]


def _window(ellipses: Ellipses, size_px: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom (the last two exclusive) of the outlines' box on the image, left and top even."""
    if len(ellipses) == 0:
        return 0, 0, 2, 2
    reach = np.sqrt(np.einsum("mij,mij->mi", ellipses.shapes_px, ellipses.shapes_px)) + _MARGIN_PX
    low = np.floor((ellipses.centers_px - reach).min(axis=0)).astype(int) // 2 * 2
    high = np.ceil((ellipses.centers_px + reach).max(axis=0)).astype(int) + 1
    width, height = size_px
    left, top = (int(np.clip(value, 0, size - 2)) for value, size in zip(low, size_px, strict=True))
    return left, top, int(np.clip(high[0], left + 2, width)), int(np.clip(high[1], top + 2, height))


def _image_signal(
    images: StereoImages, eye: Eye, window: tuple[int, int, int, int], channel: tuple[int | None, float]
) -> MarkerSignal:
    color, others_weight = channel
    left, top, right, bottom = window
    image = images.left if eye == "left" else images.right
    part = image[top:bottom, left:right]
    cut = replace(images, left=part, right=part, left_mosaic=None, right_mosaic=None)
    full = 2**images.bits - 1
    is_difference = color is not None and image.ndim == 3
    if color is not None and image.ndim == 3:
        values: Pixels | Array32 = color_difference(cut, "left", color, others_weight)
    else:
        values = marker_channel(cut, "left", color, others_weight)
    if part.ndim == 3:
        part = part.max(axis=2) if color is None else part[..., color]
    own = part if is_difference and images.encoding == "linear" else None
    signal = values.astype(np.float32, copy=False)
    return MarkerSignal(signal, part >= full, (float(left), float(top)), 1, is_difference, own)


def _mosaic_signal(
    images: StereoImages, mosaic: Pixels, window: tuple[int, int, int, int], channel: tuple[int, float]
) -> MarkerSignal:
    color, others_weight = channel
    left, top, right, bottom = window
    part = mosaic[top : top + (bottom - top) // 2 * 2, left : left + (right - left) // 2 * 2]
    row, column = _FIRST_SITE[color]
    own = part[row::2, column::2]
    # Reflection about the outermost site, OpenCV's default, keeps the colours of the mosaic.
    first, second = (
        cv2.filter2D(part, cv2.CV_32F, kernel)[row::2, column::2] for kernel in _NEIGHBOURS[color == _GREEN]
    )
    values = own - np.float32(others_weight) * np.maximum(first, second)
    clipped = own >= 2**images.bits - 1
    return MarkerSignal(values, clipped, (float(left + column), float(top + row)), 2, True)
