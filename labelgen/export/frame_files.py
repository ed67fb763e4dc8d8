"""Exports image files of a dataset's frames: as hard links, copies or converted to 8 bits."""

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
from geometry.stereo import Eye
from labelgen.export.export_log import ExportLog

ImageBits = Literal[8, 16]


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
        OSError: it cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except FileExistsError:
        raise
    except OSError:
        # Another disk, or one without hard links.
        shutil.copyfile(source, target)


def export_image(
    source: Dataset, frame_index: int, eye: Eye, target: Path, log: ExportLog, bits: ImageBits = 8
) -> None:
    """Write one eye's image as a PNG whose values use the whole range of its samples, as most programs expect.

    Args:
        source: the dataset.
        frame_index: which pair.
        eye: which image.
        target: the PNG to make. An image of 8 bits is linked or copied. Of 12 bits, the upper 8 are written, or all of
            them in 16: moved to the top, with an sBIT chunk that says how many are significant.
        log: counts the images that lose bits or their raw mosaic.
        bits: of a sample, at most.

    Raises:
        ValueError: the image is missing or damaged; names the file.
        OSError: it cannot be written.
    """
    name, sensor = image_file(eye), source.manifest.recipe.sensor
    stored_bits = sensor.output_bits
    if sensor.color == "bayer":
        log.lost("images of a Bayer sensor: interpolated, without the raw mosaic, which navigation prefers")
    if stored_bits == 8:
        export_file(source, frame_index, name, target)
        return
    if bits == 8:
        where = source.frames.where(frame_index, name)
        pixels = decode_png(source.frames.read(frame_index, name), where, source.manifest.recipe.rig.camera)
        data = encode_png((pixels >> (stored_bits - 8)).astype(np.uint8))
        log.lost(f"images of {stored_bits} bits: written with their upper 8")
    else:
        data = full_range_png(source, frame_index, name)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)


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
