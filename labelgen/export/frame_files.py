"""Exports image files of a dataset's frames: as hard links, copies or converted to 8 bits."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from datasets_manifest.storage.image_codecs import decode_png, encode_png
from datasets_manifest.storage.layout import image_file
from datasets_manifest.storage.reader import Dataset
from geometry.stereo import Eye
from labelgen.export.export_log import ExportLog


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


def export_image(source: Dataset, frame_index: int, eye: Eye, target: Path, log: ExportLog) -> None:
    """Write one eye's image for programs that take 8 bits a sample.

    Args:
        source: the dataset.
        frame_index: which pair.
        eye: which image.
        target: the PNG to make: a link or a copy, or the upper 8 of 12 bits.
        log: counts the images that lose bits.

    Raises:
        ValueError: the image is missing or damaged; names the file.
        OSError: it cannot be written.
    """
    name, bits = image_file(eye), source.manifest.recipe.sensor.output_bits
    if bits == 8:
        export_file(source, frame_index, name, target)
        return
    where = source.frames.where(frame_index, name)
    pixels = decode_png(source.frames.read(frame_index, name), where) >> (bits - 8)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(encode_png(pixels.astype(np.uint8)))
    log.lost(f"images of {bits} bits: written with their upper 8")
