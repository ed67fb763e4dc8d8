"""Lossless images to and from PNG bytes, in the order red, green, blue."""

from __future__ import annotations

import struct
import zlib
from typing import Any, cast

import cv2
import numpy as np

from datasets_manifest.types.images import Pixels

_SIGNATURE = b"\x89PNG\r\n\x1a\n"

# Noise has no repeats to search for: Huffman codes alone take half the time of level 1 and a sixth less room. Part ids
# are runs. Without a level given, OpenCV filters every row by the difference to the left, which is the cheapest.
_OF_NOISE = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
_OF_RUNS = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)


def encode_png(pixels: Pixels, of_areas: bool = False) -> bytes:
    """PNG of an (H, W) or (H, W, 3) image; 12-bit values stay as they are in 16-bit samples.

    Args:
        pixels: the image.
        of_areas: its values are even over areas, as part ids are, instead of noisy as a picture; for size and speed.

    Raises:
        ValueError: the image cannot be encoded.
    """
    # OpenCV's channel order is blue, green, red.
    image = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    done, data = cv2.imencode(".png", image, _OF_RUNS if of_areas else _OF_NOISE)
    if not done:
        raise ValueError(f"image: cannot be written as PNG, got {pixels.shape} {pixels.dtype}")
    return data.tobytes()


def decode_png(data: bytes, name: str) -> Pixels:
    """The image in PNG bytes, with the depth and the channels that it is stored with.

    Args:
        data: the whole file.
        name: what to call it in errors.

    Raises:
        ValueError: not a PNG, truncated or damaged, or not 8 or 16 bit grey or RGB.
    """
    fault = png_fault(data)
    if fault is not None:
        raise ValueError(f"{name}: {fault}")
    image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{name}: the PNG cannot be decoded")
    if image.dtype not in (np.uint8, np.uint16) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"{name}: must be 8 or 16 bit grey or RGB, got {image.shape} {image.dtype}")
    return cast(Pixels, cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image)


def png_fault(data: bytes) -> str | None:
    """What is wrong with the chunks of a PNG, or None: found here, a damaged file never reaches the decoder.

    Source: PNG specification (ISO/IEC 15948), section 5.3: length, type, data, CRC of type and data.
    """
    if not data.startswith(_SIGNATURE):
        return "not a PNG file"
    position = len(_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
            return "the PNG is damaged (wrong checksum)"
        if data[position + 4 : position + 8] == b"IEND":
            return None
        position = end
    return "the PNG is truncated"
