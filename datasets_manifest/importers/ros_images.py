"""Images in messages of ROS: `sensor_msgs/Image` and `CompressedImage`, of a bag or of a running node."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np

from datasets_manifest.types.images import Pixels

# Bayer patterns by their first two pixels; OpenCV names them by the second row's second and third.
BAYER_TO_RGB = {
    "bayer_rggb": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg": cv2.COLOR_BayerGB2RGB,
}
_CHANNELS = {"rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4, "mono": 1}


def message_stamp_ns(message: Any) -> int:
    """The time stamp in a message's header. [ns]"""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def decode_image(message: Any, name: str) -> Pixels:
    """The pixels of an Image or CompressedImage: (H, W, 3) red, green, blue, or (H, W) grey.

    Raises:
        ValueError: an encoding that is not known, or data of another length; names the image.
    """
    if hasattr(message, "format"):
        return _decompressed(message, name)
    found = re.fullmatch(r"(bayer_[a-z]{4}|[a-z]+)(8|16)", message.encoding)
    channels = None if found is None else 1 if found[1] in BAYER_TO_RGB else _CHANNELS.get(found[1])
    if found is None or channels is None:
        raise ValueError(
            f"{name}: encoding {message.encoding!r} is not read; use rgb8, bgr8, mono8, bayer_rggb8 or the like"
        )
    kind, dtype = found[1], np.dtype(f"{'>' if message.is_bigendian else '<'}u{int(found[2]) // 8}")
    row_bytes = message.width * channels * dtype.itemsize
    if not row_bytes or message.step < row_bytes or len(message.data) != message.step * message.height:
        raise ValueError(f"{name}: {len(message.data)} bytes are not an image of {message.width}x{message.height}")
    rows = np.asarray(message.data).reshape(message.height, message.step)[:, :row_bytes]
    values = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    image = values.reshape(message.height, message.width, channels)
    if kind in BAYER_TO_RGB:
        return np.asarray(cv2.cvtColor(image, BAYER_TO_RGB[kind]))
    if channels == 1:
        return np.ascontiguousarray(image[:, :, 0])
    return np.ascontiguousarray(image[:, :, 2::-1] if kind.startswith("bgr") else image[:, :, :3])


def _decompressed(message: Any, name: str) -> Pixels:
    try:
        image = cv2.imdecode(np.asarray(message.data), cv2.IMREAD_UNCHANGED) if len(message.data) else None
    except cv2.error as error:
        raise ValueError(f"{name}: {' '.join(str(error).split())[:200]}") from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{name}: is truncated, or not a compressed image of 8 or 16 bits")
    return np.asarray(image) if image.ndim == 2 else np.ascontiguousarray(image[:, :, 2::-1])
