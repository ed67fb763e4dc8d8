"""Image files to and from bytes: lossless PNG, and the noise-free passes of an eye in OpenEXR."""

from __future__ import annotations

import struct
import zlib
from typing import Any, NamedTuple, Protocol, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import scratch_folder
from datasets_manifest.types.images import Pixels
from drogue_models.untrusted_files import limited_memory
from geometry.pinhole import PinholeCamera

MOST_PIXELS = 150_000_000
"""Most pixels of an image whose size is not known from its rig: as many as the largest sensors and maps of 16k have."""
# Small images may be of one value, which takes a thousandth of their size; no camera makes a large one.
_FREE_BYTES, _MOST_EXPANSION = 2**28, 100
# Samples of a pixel by the colour type in a PNG's header.
_PNG_SAMPLES = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

# Noise has no repeats to search for: Huffman coding alone takes half the time of level 1 and a sixth less space. Part
# ids consist of runs. Without a level, OpenCV filters every row by the difference to the left, the cheapest filter.
_PNG_NOISE_OPTIONS = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
_PNG_RUNS_OPTIONS = (cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)


def encode_png(pixels: Pixels, is_piecewise_constant: bool = False) -> bytes:
    """PNG of an (H, W) or (H, W, 3) image in RGB order; 12-bit values are stored unchanged in 16-bit samples.

    Args:
        pixels: the image.
        is_piecewise_constant: whether it has areas of one value, as part ids do, instead of noise; chooses the
            compression.

    Raises:
        ValueError: the image cannot be encoded.
    """
    # OpenCV's channel order is blue, green, red.
    image = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    done, data = cv2.imencode(".png", image, _PNG_RUNS_OPTIONS if is_piecewise_constant else _PNG_NOISE_OPTIONS)
    if not done:
        raise ValueError(f"image: cannot be written as PNG, got {pixels.shape} {pixels.dtype}")
    return data.tobytes()


def decode_png(data: bytes, name: str, camera: PinholeCamera) -> Pixels:
    """The image in PNG bytes, in RGB order, with its stored depth and channels.

    Args:
        data: the whole file.
        name: of the file, for errors.
        camera: gives the size that the image must have; a file of another size never reaches the decoder, as a
            megabyte can hold an image of gigabytes.

    Raises:
        ValueError: not a PNG, truncated, damaged, of another size, or not 8 or 16 bit grey or RGB.
    """
    fault = png_fault(data, camera)
    if fault is not None:
        raise ValueError(f"{name}: {fault}")
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"{name}: the PNG cannot be decoded: {' '.join(str(error).split())[:200]}") from error
    if image is None:
        raise ValueError(f"{name}: the PNG cannot be decoded")
    if image.dtype not in (np.uint8, np.uint16) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"{name}: must be 8 or 16 bit grey or RGB, got {image.shape} {image.dtype}")
    return cast(Pixels, cv2.cvtColor(image, cv2.COLOR_BGR2RGB) if image.ndim == 3 else image)


def png_fault(data: bytes, camera: PinholeCamera) -> str | None:
    """The fault in the size or the chunks of a PNG, or None; checked first, so that no such file reaches the decoder.

    Source: PNG specification (ISO/IEC 15948), sections 5.3 (length, type, data, CRC of type and data) and 11.2.2 (the
    header with the size is the first chunk).
    """
    if not data.startswith(_PNG_SIGNATURE):
        return "not a PNG file"
    position = len(_PNG_SIGNATURE)
    if len(data) < position + 18:
        return "the PNG is truncated"
    if data[position + 4 : position + 8] != b"IHDR":
        return "the PNG is damaged (no header)"
    size_px = struct.unpack_from(">II", data, position + 8)
    if size_px != (camera.width_px, camera.height_px):
        return f"must be {camera.width_px} x {camera.height_px} px, got {size_px[0]} x {size_px[1]}"
    try:
        bits, color = data[position + 16 : position + 18]
        check_image_size(*size_px, _PNG_SAMPLES.get(color, 4) * max(1, bits // 8), len(data))
    except ValueError as error:
        return str(error)
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


EXR_CHANNELS = ("R", "G", "B", "depth.Z", "normal.X", "normal.Y", "normal.Z", "id.X")
_EXR_MAGIC = 20000630
# Version 2 with none of the flags for tiles, deep pixels and several parts; long names alone are harmless.
_EXR_PLAIN_VERSIONS = (2, 2 | 0x400)
_EXR_MAX_HEADER_BYTES = 65536
_EXR_LEAST_CHANNEL_BYTES, _EXR_SAMPLE_BYTES = 18, 4


class EyePasses(Protocol):
    """Radiance and passes of one eye, as an engine gives them."""

    @property
    def radiance_cd_m2(self) -> NDArray[np.float32]:
        """(H, W, 3). [cd/m2]"""
        ...

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """(H, W) planar depth, inf for sky. [m]"""
        ...

    @property
    def normal(self) -> NDArray[np.float32]:
        """(H, W, 3) in the eye's frame."""
        ...

    @property
    def part_id(self) -> NDArray[np.uint8]:
        """(H, W)."""
        ...


def encode_passes(seen: EyePasses) -> bytes:
    """A single-part float32 EXR file: radiance as `R G B`, `depth.Z`, `normal.X/Y/Z`, part id as `id.X`."""
    import OpenEXR

    channels = {
        **{name: seen.radiance_cd_m2[..., index] for index, name in enumerate("RGB")},
        "depth.Z": seen.depth_m,
        **{f"normal.{name}": seen.normal[..., index] for index, name in enumerate("XYZ")},
        "id.X": seen.part_id.astype(np.float32),
    }
    # ZIP is what cv2, Mitsuba and Blender all read.
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    contiguous = {name: np.ascontiguousarray(values, dtype=np.float32) for name, values in channels.items()}
    with scratch_folder() as folder:
        path = folder / "passes.exr"
        OpenEXR.File(header, contiguous).write(str(path))
        return path.read_bytes()


def read_passes(data: bytes, name: str, camera: PinholeCamera) -> dict[str, NDArray[np.float32]]:
    """(H, W) by channel: radiance [cd/m2], planar depth [m], normal and part id (`encode_passes`).

    Args:
        data: the whole file.
        name: of the file, for errors.
        camera: gives the size that the image must have; a file of another size never reaches the decoder.

    Raises:
        ValueError: not an EXR file, truncated, damaged, of another size, or without one of the channels.
    """
    size = (camera.width_px, camera.height_px)
    header = _exr_header(data)
    window = None if header is None else header.window
    if window != (0, 0, size[0] - 1, size[1] - 1):
        raise ValueError(f"{name}: must be an EXR file of one part and {size} px, got {window}")
    try:
        planes = decode_exr(data)
    except ValueError as error:
        raise ValueError(f"{name}: cannot be read as EXR: {error}") from error
    for channel in EXR_CHANNELS:
        if channel not in planes or planes[channel].shape != size[::-1] or planes[channel].dtype != np.float32:
            raise ValueError(f"{name}: channel {channel}: must be {size[::-1]} of float32")
    return {channel: planes[channel].astype(np.float32, copy=False) for channel in EXR_CHANNELS}


def decode_exr(data: bytes) -> dict[str, NDArray[np.generic]]:
    """The planes of a single-part EXR file by channel, as stored.

    Raises:
        ValueError: no readable header, a size that `check_image_size` refuses, or a message of the library on one line.
    """
    import OpenEXR

    header = _exr_header(data)
    if header is None:
        raise ValueError("has no header of a plain EXR file of one part")
    left, top, right, bottom = header.window
    check_image_size(right - left + 1, bottom - top + 1, _EXR_SAMPLE_BYTES * header.channel_count, len(data))
    try:
        # The library reads files only.
        with scratch_folder() as folder, limited_memory(len(data)):
            copy = folder / "image.exr"
            copy.write_bytes(data)
            with OpenEXR.File(str(copy), separate_channels=True) as file:
                return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, TypeError, KeyError, IndexError, MemoryError) as error:
        message = " ".join(str(error).replace(str(folder), "").split()) or type(error).__name__
        raise ValueError(message) from error


def check_image_size(width_px: int, height_px: int, bytes_per_px: float, file_bytes: int) -> None:
    """Refuse an image that would fill the memory, before anything decodes it.

    Args:
        width_px, height_px: size of the image.
        bytes_per_px: of the decoded image.
        file_bytes: size of the file.

    Raises:
        ValueError: more than `MOST_PIXELS`, a side of no pixels, or far more than so small a file can hold of a
            camera's image.
    """
    if min(width_px, height_px) < 1 or width_px * height_px > MOST_PIXELS:
        raise ValueError(f"must have 1 to {MOST_PIXELS} pixels, got {width_px} x {height_px}")
    decoded = round(width_px * height_px * bytes_per_px)
    if decoded > max(_FREE_BYTES, _MOST_EXPANSION * file_bytes):
        raise ValueError(f"must not expand more than {_MOST_EXPANSION} times, got {file_bytes} bytes of {decoded}")


class _ExrHeader(NamedTuple):
    """What is known of an EXR file before it is decoded.

    Attributes:
        window: lowest x and y, highest x and y of the pixels.
        channel_count: number of channels.
    """

    window: tuple[int, int, int, int]
    channel_count: int


def _exr_header(data: bytes) -> _ExrHeader | None:
    """The header of a plain EXR file, or None without a readable one.

    Source: OpenEXR's description of its file layout: magic number, version, then attributes, each a name, a type, both
    ended by 0, a size and a value; an empty name ends the header.
    """
    if len(data) < 8 or struct.unpack_from("<ii", data) not in [
        (_EXR_MAGIC, version) for version in _EXR_PLAIN_VERSIONS
    ]:
        return None
    position = 8
    window: tuple[int, int, int, int] | None = None
    channel_count = 0
    while position < min(len(data), _EXR_MAX_HEADER_BYTES):
        name_end = data.find(b"\0", position)
        if name_end == position:
            break
        type_end = data.find(b"\0", name_end + 1)
        if name_end in (-1, position) or type_end == -1 or type_end + 5 > len(data):
            return None
        (size,) = struct.unpack_from("<i", data, type_end + 1)
        value = type_end + 5
        if size < 0 or value + size > len(data):
            return None
        if data[position:name_end] == b"dataWindow" and size == 16:
            left, top, right, bottom = struct.unpack_from("<iiii", data, value)
            window = left, top, right, bottom
        elif data[position:name_end] == b"channels":
            # Each is a name that ends by 0 and 16 bytes; names have at least one character, and one 0 ends the list.
            channel_count = size // _EXR_LEAST_CHANNEL_BYTES
        position = value + size
    return None if window is None else _ExrHeader(window, channel_count)
