"""Images in messages of ROS: `sensor_msgs/Image` and `CompressedImage`, of a bag or of a running node."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import cv2
import numpy as np

from datasets_manifest.importers.image_files import decode_image_file
from datasets_manifest.types.images import Pixels

# Bayer patterns by their first two pixels; OpenCV names them by the second row's second and third.
BAYER_TO_RGB = {
    "bayer_rggb": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg": cv2.COLOR_BayerGB2RGB,
}
# `8UC1` and the like are OpenCV's names of grey images; of `8UC3` the order of the colours is unknown.
_CHANNELS = {"rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4, "mono": 1}
_OPENCV_GREY = {"8UC1": "mono8", "16UC1": "mono16"}


class RosImage(NamedTuple):
    """One decoded image.

    Attributes:
        pixels: (H, W, 3) red, green, blue, or (H, W) grey; interpolated from a Bayer mosaic.
        mosaic: (H, W) the raw mosaic where its first row begins with red, green, else None.
        is_turned: whether it was turned as its EXIF orientation says.
    """

    pixels: Pixels
    mosaic: Pixels | None = None
    is_turned: bool = False


def message_stamp_ns(message: Any) -> int:
    """The time stamp in a message's header. [ns]"""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def decode_image(message: Any, name: str) -> RosImage:
    """The image in an Image or CompressedImage.

    Raises:
        ValueError: an encoding that is not known, or data of another length; names the image.
    """
    if hasattr(message, "format"):
        return _decompressed(message, name)
    encoding = _OPENCV_GREY.get(message.encoding, message.encoding)
    found = re.fullmatch(r"(bayer_[a-z]{4}|[a-z]+)(8|16)", encoding)
    channels = None if found is None else 1 if found[1] in BAYER_TO_RGB else _CHANNELS.get(found[1])
    if found is None or channels is None:
        raise ValueError(f"{name}: encoding {encoding!r} is not read; use rgb8, bgr8, mono8, bayer_rggb8 or the like")
    kind, dtype = found[1], np.dtype(f"{'>' if message.is_bigendian else '<'}u{int(found[2]) // 8}")
    row_bytes = message.width * channels * dtype.itemsize
    if (
        not row_bytes
        or not message.height
        or message.step < row_bytes
        or len(message.data) != message.step * message.height
    ):
        raise ValueError(f"{name}: {len(message.data)} bytes are not an image of {message.width}x{message.height}")
    rows = np.asarray(message.data).reshape(message.height, message.step)[:, :row_bytes]
    values = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    image = values.reshape(message.height, message.width, channels)
    if channels == 1:
        return _interpolated(np.ascontiguousarray(image[:, :, 0]), kind)
    return RosImage(np.ascontiguousarray(image[:, :, 2::-1] if kind.startswith("bgr") else image[:, :, :3]))


def _decompressed(message: Any, name: str) -> RosImage:
    pixels, is_turned = decode_image_file(np.asarray(message.data, dtype=np.uint8), name)
    # Before a semicolon the format has the encoding of the image that was compressed.
    kind = message.format.partition(";")[0].strip()[: len("bayer_rggb")]
    if kind in BAYER_TO_RGB and pixels.ndim == 2:
        if is_turned:
            raise ValueError(f"{name}: is a mosaic with an EXIF orientation, which would move its colours")
        return _interpolated(pixels, kind)
    return RosImage(pixels, is_turned=is_turned)


def _interpolated(grey: Pixels, kind: str) -> RosImage:
    """A grey image, or the colours of a mosaic."""
    if kind not in BAYER_TO_RGB:
        return RosImage(grey)
    return RosImage(np.asarray(cv2.cvtColor(grey, BAYER_TO_RGB[kind])), grey if kind == "bayer_rggb" else None)
