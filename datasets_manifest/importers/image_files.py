"""Image files of a user's camera as pixels, as `cv2.imread` gives them."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from datasets_manifest.storage.image_codecs import check_image_size
from datasets_manifest.types.images import Pixels
from drogue_models.untrusted_files import limited_memory, read_regular

IMAGE_SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")

_UPRIGHT: Final = 1
# OpenCV applies the EXIF orientation of these; TIFF has the same number as a tag of its own.
_TURNED_BY_OPENCV: Final = ("JPEG", "MPO", "PNG", "TIFF")
_PNG: Final = b"\x89PNG\r\n\x1a\n"
# Only files that begin or hold these can have an orientation or pages; Pillow decodes a whole PNG to look for it.
_TIFF_AND_WEBP: Final = (b"II", b"MM", b"RIFF")
_ORIENTATION_MARKS: Final = (b"Exif", b"eXIf", b"exif", b"adobe.xmp", b"rientation")


def read_image(path: Path) -> tuple[Pixels, bool]:
    """An image file, as `decode_image_file` gives it.

    Raises:
        ValueError: it cannot be read or decoded; names the file.
    """
    try:
        data = np.frombuffer(read_regular(path), dtype=np.uint8)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    return decode_image_file(data, str(path))


def decode_image_file(data: NDArray[np.uint8], name: str) -> tuple[Pixels, bool]:
    """The image in the bytes of a file.

    The image is turned as its EXIF orientation says, since `cv2.imread` turns the pictures of a calibration so too.

    Args:
        data: (N,) bytes.
        name: of the image, for errors.

    Returns:
        (H, W, 3) red, green, blue, or (H, W) grey, with its stored depth; and whether its orientation turned or
        mirrored it.

    Raises:
        ValueError: it cannot be decoded, has too many pixels, is not of 8 or 16 bits, has several pages, or an
            orientation that OpenCV does not apply; names the image.
    """
    _check_size(data, name)
    orientation = _orientation(data, name)
    try:
        with limited_memory(data.size):
            shown = _without_color_profile(data)
            image = cv2.imdecode(shown, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) if data.size else None
    except (cv2.error, ValueError) as error:
        raise ValueError(f"{name}: cannot be read: {' '.join(str(error).split())[:200]}") from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{name}: is truncated, or not an image of 8 or 16 bits")
    pixels = np.asarray(image) if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
    return pixels, orientation != _UPRIGHT


def _without_color_profile(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A PNG without its ICC profile, any other file as it is.

    OpenCV does not apply the profile, and its PNG library writes warnings of common faults in it to the terminal.

    Source: ISO/IEC 15948, Portable Network Graphics, 5.3 (chunks) and 5.6 (their order).
    """
    file = data.tobytes()
    place = len(_PNG)
    if not file.startswith(_PNG):
        return data
    # A profile comes before the pixels, so that most files are searched no farther than their first chunks.
    while place + 8 <= len(file) and (kind := file[place + 4 : place + 8]) != b"IDAT":
        end = place + 12 + int.from_bytes(file[place : place + 4], "big")
        if kind == b"iCCP" and end <= len(file):
            return np.frombuffer(file[:place] + file[end:], dtype=np.uint8)
        place = end
    return data


def _check_size(data: NDArray[np.uint8], name: str) -> None:
    """Refuse an image that would fill the memory; what Pillow cannot identify is left to OpenCV."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data.tobytes())) as image:
            # Pillow reads some images of 16 bits as ones of 8.
            (width_px, height_px), bytes_per_px = image.size, 2 * len(image.getbands())
    except Image.DecompressionBombError as error:
        raise ValueError(f"{name}: has too many pixels: {error}") from error
    except Exception:  # whatever a damaged file makes its reader raise
        return
    try:
        check_image_size(width_px, height_px, bytes_per_px, len(data))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _orientation(data: NDArray[np.uint8], name: str) -> int:
    """The EXIF orientation, 1 to 8, that OpenCV applies to an image; 1 where the image cannot be identified.

    Raises:
        ValueError: it has an orientation that OpenCV does not apply, or several pages.
    """
    file = data.tobytes()
    if not file.startswith(_TIFF_AND_WEBP) and not any(mark in file for mark in _ORIENTATION_MARKS):
        return _UPRIGHT
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(file)) as image:
            kind, pages = image.format, int(getattr(image, "n_frames", 1))
            said = int(image.getexif().get(ExifTags.Base.Orientation, _UPRIGHT))
            exif = Image.Exif()
            exif.load(image.info.get("exif", b""))
            applied = said if kind == "TIFF" else int(exif.get(ExifTags.Base.Orientation, _UPRIGHT))
    except Exception:  # whatever a damaged file makes its reader raise; whether it is an image, OpenCV decides
        return _UPRIGHT
    if pages > 1 and kind != "MPO":
        raise ValueError(f"{name}: holds {pages} images; save each as a file of its own")
    said, applied = (number if 1 < number <= 8 else _UPRIGHT for number in (said, applied))
    if kind not in _TURNED_BY_OPENCV:
        applied = _UPRIGHT
    if said != applied:
        raise ValueError(
            f"{name}: has the orientation {said} of EXIF, which cv2.imread does not apply, so that a calibration may "
            "not fit; save it upright"
        )
    return applied
