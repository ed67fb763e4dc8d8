"""Image files of a user's camera as pixels, as `cv2.imread` gives them."""

from __future__ import annotations

import io
import os
import re
import threading
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

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
# Only files that begin or hold these can have an orientation or pages; Pillow decodes a whole PNG to look for it.
_TIFF: Final = (b"II", b"MM")
_TIFF_AND_WEBP: Final = (*_TIFF, b"RIFF")
_ORIENTATION_MARKS: Final = (b"Exif", b"eXIf", b"exif", b"adobe.xmp", b"rientation")

_STANDARD_ERROR: Final = 2
_SILENT: Final = 0  # cv::utils::logging::LOG_LEVEL_SILENT
_STANDARD_ERROR_LOCK: Final = threading.Lock()
# Webcams put up to some ten bytes behind the last block of pixels, before the end of the image.
_FILLED: Final = rb"1?\d extraneous bytes before marker 0xd9"
# libjpeg-turbo 3, jerror.h: warnings of wrong pixels, of which it writes the first alone, and of unusual files. What
# libtiff writes of the file, which Pillow names so, beside the error that Pillow raises, is among the latter.
_DAMAGE: Final = (
    rb"Corrupt JPEG data: (?!%b)|Premature end of JPEG file|Inconsistent progression sequence |libpng error: " % _FILLED
)
_UNUSUAL: Final = (
    rb"Corrupt JPEG data: %b|libpng warning: |Invalid SOS parameters |Unknown Adobe color transform |"
    rb"Warning: unknown JFIF |[A-Z]\w*Decode\w*: |TIFF\w*: |tempfile\.tif: |JPEGLib: |Fax\w*: " % _FILLED
)
_DAMAGE_LINE: Final = re.compile(rb"^(?:%b)[^\n]*" % _DAMAGE, re.MULTILINE)
_DECODER_LINE: Final = re.compile(rb"^(?:%b|%b)[^\n]*\n?" % (_DAMAGE, _UNUSUAL), re.MULTILINE)


# Whether an image is mirrored first, and then the quarter turns to the left, by its EXIF orientation.
_TURNS: Final = {2: (True, 0), 3: (False, 2), 4: (True, 2), 5: (True, 1), 6: (False, 3), 7: (True, 3), 8: (False, 1)}


def read_image(path: Path) -> tuple[Pixels, bool]:
    """An image file of a calibrated camera, as `decode_image_file` gives it.

    Raises:
        ValueError: it cannot be read or decoded; names the file.
    """
    return decode_image_file(_read_bytes(path), str(path))


def read_photograph(path: Path) -> Pixels:
    """An image file of any camera, turned as its orientation says, also where OpenCV does not apply it.

    Raises:
        ValueError: as `decode_image_file`, but for the orientation; names the file.
    """
    pixels, said, applied = _decode_with_orientation(_read_bytes(path), str(path))
    if said == applied:
        return pixels
    is_mirrored, quarter_turns = _TURNS[said]
    return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if is_mirrored else pixels, quarter_turns))


def _read_bytes(path: Path) -> NDArray[np.uint8]:
    try:
        return np.frombuffer(read_regular(path), dtype=np.uint8)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error


def decode_image_file(data: NDArray[np.uint8], name: str) -> tuple[Pixels, bool]:
    """The image of a calibrated camera in the bytes of a file.

    The image is turned as its EXIF orientation says, since `cv2.imread` turns the pictures of a calibration so too.

    Args:
        data: (N,) bytes.
        name: of the image, for errors.

    Returns:
        (H, W, 3) red, green, blue, or (H, W) grey, with its stored depth; and whether its orientation turned or
        mirrored it.

    Raises:
        ValueError: it cannot be decoded, is damaged, has too many pixels, is not of 8 or 16 bits, has several pages, or
            an orientation that OpenCV does not apply; names the image.
    """
    pixels, said, applied = _decode_with_orientation(data, name)
    if said != applied:
        raise ValueError(
            f"{name}: has the orientation {said} of EXIF, which cv2.imread does not apply, so that a calibration may "
            "not fit; save it upright"
        )
    return pixels, applied != _UPRIGHT


def _decode_with_orientation(data: NDArray[np.uint8], name: str) -> tuple[Pixels, int, int]:
    """The image, as OpenCV decodes it, the orientation that it has, and the one that OpenCV applied."""
    _check_size(data, name)
    said, applied = _orientations(data, name)
    try:
        image, damage = _decoded(data)
    except (cv2.error, ValueError) as error:
        raise ValueError(f"{name}: cannot be read: {' '.join(str(error).split())[:200]}") from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{name}: is truncated or damaged, or not an image of 8 or 16 bits")
    if damage is not None:
        raise ValueError(f"{name}: is damaged ({damage}); copy it anew, or save it again if it looks right")
    pixels = np.asarray(image) if image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
    return pixels, said, applied


def _decoded(data: NDArray[np.uint8]) -> tuple[Any, str | None]:
    """The image in OpenCV's order, None where there is none, and what its decoder says of damage, None for nothing.

    The decoders tell of faults on standard error, most of them nowhere else, which belongs to the whole process: one
    decodes at a time, and what else is written meanwhile is passed on.

    Raises:
        ValueError: a lack of memory.
        cv2.error: a fault that OpenCV raises.
    """
    with _STANDARD_ERROR_LOCK, os.fdopen(os.memfd_create("decoder"), "w+b") as written:
        shown = os.dup(_STANDARD_ERROR)
        loudness = cv2.setLogLevel(_SILENT)
        try:
            os.dup2(written.fileno(), _STANDARD_ERROR)
            with limited_memory(data.size):
                image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH) if data.size else None
                fault = _tiff_fault(data) if image is not None and image.dtype == np.uint8 else None
        finally:
            os.dup2(shown, _STANDARD_ERROR)
            os.close(shown)
            cv2.setLogLevel(loudness)
            written.seek(0)
            said = written.read()
            if others := _DECODER_LINE.sub(b"", said):
                # Nobody may read it any more.
                with suppress(OSError):
                    os.write(_STANDARD_ERROR, others)
    damage = _DAMAGE_LINE.search(said)
    return image, fault if damage is None else damage[0].decode("ascii", "replace")


def _tiff_fault(data: NDArray[np.uint8]) -> str | None:
    """What Pillow says of the compressed pixels of a TIFF of 8 bits: OpenCV leaves out what it cannot decode there."""
    file = data.tobytes()
    if not file.startswith(_TIFF):
        return None
    with warnings.catch_warnings(action="ignore"):
        try:
            image = Image.open(io.BytesIO(file))
        except Exception:  # a TIFF of a kind that Pillow does not know
            return None
        with image:
            try:
                image.load()
            except OSError as error:
                return f"TIFF: {error}"
    return None


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


def _orientations(data: NDArray[np.uint8], name: str) -> tuple[int, int]:
    """The EXIF orientation of an image, 1 to 8, and the same or 1, as OpenCV applies it; 1 where it is no image.

    Raises:
        ValueError: it has several pages.
    """
    file = data.tobytes()
    if not file.startswith(_TIFF_AND_WEBP) and not any(mark in file for mark in _ORIENTATION_MARKS):
        return _UPRIGHT, _UPRIGHT
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(file)) as image:
            kind, pages = image.format, int(getattr(image, "n_frames", 1))
            said = int(image.getexif().get(ExifTags.Base.Orientation, _UPRIGHT))
            exif = Image.Exif()
            exif.load(image.info.get("exif", b""))
            applied = said if kind == "TIFF" else int(exif.get(ExifTags.Base.Orientation, _UPRIGHT))
    except Exception:  # whatever a damaged file makes its reader raise; whether it is an image, OpenCV decides
        return _UPRIGHT, _UPRIGHT
    if pages > 1 and kind != "MPO":
        raise ValueError(f"{name}: holds {pages} images; save each as a file of its own")
    said, applied = (number if 1 < number <= 8 else _UPRIGHT for number in (said, applied))
    return said, applied if kind in _TURNED_BY_OPENCV else _UPRIGHT
