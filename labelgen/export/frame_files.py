"""Exports image files of a dataset's frames: as hard links, copies or encoded for screens."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from pathlib import Path
from typing import Literal

import numpy as np

from datasets_manifest.storage.image_codecs import decode_png, encode_png
from datasets_manifest.storage.layout import image_file
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import Pixels, display_table
from drogue_models.untrusted_files import open_regular
from geometry.stereo import Eye
from labelgen.export.export_log import ExportLog

ImageBits = Literal[8, 16]

DISPLAY_REMARK = "linear images are written on the sRGB curve, as viewers and trained networks expect them"


def export_file(source: Dataset, frame_index: int, name: str, target: Path) -> None:
    """Write a file of a pair to `target`, as a hard link where the disk supports it.

    Raises:
        ValueError: it is missing or leads out of the frame's folder; names the file.
        OSError: it cannot be written.
    """
    path = source.frames.path(frame_index, name)
    if path is not None:
        link_or_copy(path, target)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("xb") as stream:
        stream.write(source.frames.read(frame_index, name))


def link_or_copy(source: Path, target: Path) -> None:
    """Link `target` to `source`, or copy it where the disk does not support hard links.

    Raises:
        ValueError: the source is a link; one that was looked at before may have become one.
        OSError: it cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except FileExistsError:
        raise
    except OSError:
        # Another disk, or one without hard links.
        with open_regular(source, in_folder=True) as stream, target.open("xb") as copy:
            shutil.copyfileobj(stream, copy)
    if target.is_symlink():
        target.unlink()
        raise ValueError(f"{source}: leads outside its folder")


def export_image(
    source: Dataset, frame_index: int, eye: Eye, target: Path, log: ExportLog, bits: ImageBits = 8
) -> None:
    """Write one eye's image as a PNG that programs show as bright as the scene was.

    Args:
        source: the dataset.
        frame_index: which pair.
        eye: which image.
        target: the PNG to make. With 8 bits, linear images are encoded by the sRGB curve, others linked, copied or cut
            to their upper 8 bits. With 16 bits, values stay the sensor's: images of 8 bits are linked or copied, and 12
            are moved to the top of 16, with an sBIT chunk that says how many are significant.
        log: counts the images that lose bits or their raw mosaic.
        bits: of a sample, at most.

    Raises:
        ValueError: the image is missing or damaged; names the file.
        OSError: it cannot be written.
    """
    name, sensor = image_file(eye), source.manifest.recipe.sensor
    stored_bits, is_linear = sensor.output_bits, sensor.encoding == "linear"
    _tell_of_mosaic(source, log)
    if stored_bits == 8 and not (is_linear and bits == 8):
        export_file(source, frame_index, name, target)
        return
    if bits == 16:
        data = full_range_png(source, frame_index, name)
    elif is_linear:
        data = display_png(source, frame_index, name, bits)
        log.remark(DISPLAY_REMARK)
        if stored_bits > 8:
            log.lost(f"images of {stored_bits} bits: written with 8, on the sRGB curve")
    else:
        data = encode_png((_pixels(source, frame_index, name) >> (stored_bits - 8)).astype(np.uint8))
        log.lost(f"images of {stored_bits} bits: written with their upper 8")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)


def export_measured_image(source: Dataset, frame_index: int, eye: Eye, target: Path, log: ExportLog) -> None:
    """Write one eye's image as `export_image` does, with the sensor's own values: for programs that measure.

    Raises:
        ValueError: the image is missing or damaged; names the file.
        OSError: it cannot be written.
    """
    name, bits = image_file(eye), source.manifest.recipe.sensor.output_bits
    _tell_of_mosaic(source, log)
    if bits == 8:
        export_file(source, frame_index, name, target)
        return
    pixels = _pixels(source, frame_index, name)
    log.lost(f"images of {bits} bits: written with their upper 8")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(encode_png((pixels >> (bits - 8)).astype(np.uint8)))


def _tell_of_mosaic(source: Dataset, log: ExportLog) -> None:
    if source.manifest.recipe.sensor.color == "bayer":
        log.lost("images of a Bayer sensor: interpolated, without the raw mosaic, which navigation prefers")


def _pixels(source: Dataset, frame_index: int, name: str) -> Pixels:
    """Raises ValueError where the file is missing or damaged."""
    where = source.frames.where(frame_index, name)
    return decode_png(source.frames.read(frame_index, name), where, source.manifest.recipe.rig.camera)


def display_png(source: Dataset, frame_index: int, name: str, bits: ImageBits) -> bytes:
    """A frame's image on the sRGB curve, 0 at its black level, as a PNG.

    16 bits keep all of a linear image's values above the black level apart.

    Raises:
        ValueError: image or record is missing or damaged; names the file.
    """
    sensor = source.manifest.recipe.sensor
    black_level_dn = source.shutter(frame_index).black_level_dn
    table = display_table(sensor.encoding, sensor.output_bits, black_level_dn, bits)
    shown = np.take(table, _pixels(source, frame_index, name), mode="clip")
    return encode_png(shown.astype(np.uint8) if bits == 8 else shown.astype(np.uint16))


def full_range_png(source: Dataset, frame_index: int, name: str) -> bytes:
    """A frame's image or mosaic with all of its bits, as a PNG whose values use the whole range of its samples.

    Of 8 bits it is the file itself. Of 12, values are moved to the top of 16, with an sBIT chunk that says how many
    bits are significant.

    Raises:
        ValueError: the file is missing or damaged; names it.
    """
    data, bits = source.frames.read(frame_index, name), source.manifest.recipe.sensor.output_bits
    if bits == 8:
        return data
    pixels = decode_png(data, source.frames.where(frame_index, name), source.manifest.recipe.rig.camera)
    # The upper bits again below, so that the largest number stays the largest.
    low = 16 - bits
    whole = (pixels << low | pixels >> (bits - low)).astype(np.uint16)
    return with_significant_bits(encode_png(whole), bits, channels=1 if pixels.ndim == 2 else 3)


def with_significant_bits(png: bytes, bits: int, channels: int) -> bytes:
    """The PNG with an sBIT chunk: the upper `bits` of every channel are the camera's.

    Source: PNG specification (ISO/IEC 15948), sections 11.3.2.4 (sBIT) and 13.12 (scaling by replication of bits).
    """
    # The signature and the header, which is always first and of one length.
    header_end = 8 + 25
    body = b"sBIT" + bytes([bits] * channels)
    return (
        png[:header_end] + struct.pack(">I", channels) + body + struct.pack(">I", zlib.crc32(body)) + png[header_end:]
    )
