"""The noise-free passes of an eye, read from the bytes of its EXR file."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geometry.pinhole import PinholeCamera

CHANNELS = ("R", "G", "B", "depth.Z", "normal.X", "normal.Y", "normal.Z", "id.X")
_MAGIC = 20000630
# Version 2 with none of the flags for tiles, deep pixels and several parts; long names alone are harmless.
_PLAIN_VERSIONS = (2, 2 | 0x400)
_MOST_HEADER_BYTES = 65536


def read_passes(data: bytes, name: str, camera: PinholeCamera) -> dict[str, NDArray[np.float32]]:
    """(H, W) by channel: radiance [cd/m2], planar depth [m], normal and part id (`render.exr_writer`).

    Args:
        data: the whole file.
        name: what to call it in errors.
        camera: whose size the image must have; a file of another size never reaches the decoder.

    Raises:
        ValueError: no EXR file, truncated, damaged, of another size, or without one of the channels.
    """
    size = (camera.width_px, camera.height_px)
    window = _data_window(data)
    if window != (0, 0, size[0] - 1, size[1] - 1):
        raise ValueError(f"{name}: must be an EXR file of one part and {size} px, got {window}")
    try:
        planes = decode_exr(data)
    except ValueError as error:
        raise ValueError(f"{name}: cannot be read as EXR: {error}") from error
    for channel in CHANNELS:
        if channel not in planes or planes[channel].shape != size[::-1] or planes[channel].dtype != np.float32:
            raise ValueError(f"{name}: channel {channel}: must be {size[::-1]} of float32")
    return {channel: planes[channel].astype(np.float32, copy=False) for channel in CHANNELS}


def decode_exr(data: bytes) -> dict[str, NDArray[np.generic]]:
    """The planes of a single-part EXR file by channel, as they are stored.

    Raises:
        ValueError: the library cannot read it; its one-line message.
    """
    import OpenEXR

    try:
        # The library reads files only.
        with tempfile.TemporaryDirectory(prefix="droguekit-") as folder:
            copy = Path(folder) / "image.exr"
            copy.write_bytes(data)
            with OpenEXR.File(str(copy), separate_channels=True) as file:
                return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError, IndexError, MemoryError) as error:
        message = " ".join(str(error).replace(folder, "").split()) or type(error).__name__
        raise ValueError(message) from error


def _data_window(data: bytes) -> tuple[int, int, int, int] | None:
    """Lowest and highest x and y of a plain EXR file's pixels, or None where the header does not tell.

    Source: OpenEXR's description of its file layout: magic number, version, then attributes, each a name, a type, both
    ended by 0, a size and a value; an empty name ends the header.
    """
    if len(data) < 8 or struct.unpack_from("<ii", data) not in [(_MAGIC, version) for version in _PLAIN_VERSIONS]:
        return None
    position = 8
    while position < min(len(data), _MOST_HEADER_BYTES):
        name_end = data.find(b"\0", position)
        type_end = data.find(b"\0", name_end + 1)
        if name_end in (-1, position) or type_end == -1 or type_end + 5 > len(data):
            return None
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        value = type_end + 5
        if size < 0 or value + size > len(data):
            return None
        if data[position:name_end] == b"dataWindow" and size == 16:
            left, top, right, bottom = struct.unpack_from("<iiii", data, value)
            return left, top, right, bottom
        position = value + size
    return None
