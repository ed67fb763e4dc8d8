"""The input image of a detector network, and the map between its coordinates and those of the camera image.

Training and inference both use this module, so that they see the same pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import Pixels, StereoImages, display_table
from geometry.se3 import Array
from geometry.stereo import Eye
from nav.detector.output_maps import MAX_SIDE_PX, SIZE_STEP_PX

PADDING_DN = 114
"""Grey of the padding: between the brightness of sky and ground, so that its edge has little contrast."""


@dataclass(frozen=True)
class Letterbox:
    """Where an image lies in a network's padded input.

    Attributes:
        scale: (2,) input pixels per image pixel, in x and y; they differ because sizes are rounded to whole pixels.
        offset_px: (2,) low corner of the image in the input. [px]
    """

    scale: tuple[float, float]
    offset_px: tuple[int, int]

    def to_input(self, boxes_xywh_px: Array) -> Array:
        """Map (n, 4) boxes from pixel-centre coordinates of the image, as in records, to corner ones of the input."""
        boxes = np.asarray(boxes_xywh_px, dtype=np.float64).reshape(-1, 4)
        return np.hstack(((boxes[:, :2] + 0.5) * self.scale + self.offset_px, boxes[:, 2:] * self.scale))

    def to_image(self, boxes_xywh_px: Array) -> Array:
        """Map (n, 4) boxes from corner coordinates of the input to pixel-centre ones of the image."""
        boxes = np.asarray(boxes_xywh_px, dtype=np.float64).reshape(-1, 4)
        return np.hstack(((boxes[:, :2] - self.offset_px) / self.scale - 0.5, boxes[:, 2:] / self.scale))


def letterbox(image_size_px: tuple[int, int], input_size_px: tuple[int, int]) -> Letterbox:
    """The image as large as it fits, centred.

    Args:
        image_size_px: width, height.
        input_size_px: width, height; multiples of 32.

    Raises:
        ValueError: an input size that no network accepts.
    """
    if min(input_size_px) < SIZE_STEP_PX or any(side % SIZE_STEP_PX for side in input_size_px):
        width, height = input_size_px
        raise ValueError(f"input_size_px: must be multiples of {SIZE_STEP_PX}, got {width}x{height}")
    if max(input_size_px) > MAX_SIDE_PX:
        width, height = input_size_px
        raise ValueError(f"input_size_px: must be at most {MAX_SIDE_PX} a side, got {width}x{height}")
    fit = min(inside / side for inside, side in zip(input_size_px, image_size_px, strict=True))
    width, height = (max(1, round(side * fit)) for side in image_size_px)
    offset = (input_size_px[0] - width) // 2, (input_size_px[1] - height) // 2
    return Letterbox((width / image_size_px[0], height / image_size_px[1]), offset)


def input_image(
    images: StereoImages, eye: Eye, input_size_px: tuple[int, int], enlarged: int = 1
) -> tuple[NDArray[np.uint8], Letterbox]:
    """The image of one eye as a network's input: 8 bit, display-encoded, at the network's size.

    Light above the black level is encoded by the sRGB curve, whatever the sensor's encoding and bit depth. The image is
    then resized by area averaging and padded with grey. A mono image becomes three equal channels.

    Args:
        images: the pair.
        eye: which image.
        input_size_px: width, height; multiples of 32.
        enlarged: how many times as wide and high the result is, with the image at the same place in it.

    Returns:
        (enlarged * height, enlarged * width, 3) red, green, blue, and where the image lies in the input.

    Raises:
        ValueError: an input size that no network accepts.
    """
    encoded = _display_encoded(images.left if eye == "left" else images.right, images)
    return letterbox_image(encoded, input_size_px, enlarged)


def letterbox_image(
    image: NDArray[np.uint8], input_size_px: tuple[int, int], enlarged: int = 1
) -> tuple[NDArray[np.uint8], Letterbox]:
    """Resize and pad a display-encoded image (H, W, 3) or (H, W) to a network's input; see `input_image`."""
    height, width = image.shape[:2]
    placement = letterbox((width, height), input_size_px)
    size = enlarged * round(width * placement.scale[0]), enlarged * round(height * placement.scale[1])
    grows = enlarged * placement.scale[0] > 1
    resized = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR if grows else cv2.INTER_AREA)
    if resized.ndim == 2:
        resized = cv2.cvtColor(resized, cv2.COLOR_GRAY2RGB)
    whole = enlarged * input_size_px[0], enlarged * input_size_px[1]
    if size == whole:
        return np.asarray(resized), placement
    padded = np.full((whole[1], whole[0], 3), PADDING_DN, np.uint8)
    left, top = (enlarged * side for side in placement.offset_px)
    padded[top : top + size[1], left : left + size[0]] = resized
    return padded, placement


def network_input(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """(B, 3, H, W) from 0 to 1, of B images (H, W, 3)."""
    height, width = images[0].shape[:2]
    batch = np.empty((len(images), 3, height, width), np.float32)
    for image, planes in zip(images, batch, strict=True):
        # OpenCV takes half the time of a strided copy in numpy.
        for channel, plane in enumerate(cv2.split(image)):
            planes[channel] = plane
    batch *= np.float32(1 / 255)
    return batch


def _display_encoded(image: Pixels, images: StereoImages) -> NDArray[np.uint8]:
    """The image in 8 bits, encoded by the sRGB curve (IEC 61966-2-1), 0 at the black level."""
    if images.encoding == "gamma" and images.bits == 8 and images.black_level_dn == 0:
        return image.astype(np.uint8, copy=False)
    table = display_table(images.encoding, images.bits, images.black_level_dn)
    if image.dtype == np.uint8:
        return np.asarray(cv2.LUT(image, table), dtype=np.uint8)
    return np.take(table, image, mode="clip")
