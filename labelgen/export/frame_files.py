"""Files of a dataset's frames on their way into an export."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from datasets_manifest.layout import frame_folder, image_file
from datasets_manifest.png import decode_png, encode_png
from datasets_manifest.reader import Dataset, read_frame_bytes
from geometry.stereo import Eye
from labelgen.export.log import ExportLog


def frame_file(dataset: Path, frame_index: int, name: str) -> Path:
    """A file of a pair, which must lie in its folder itself and not behind a link.

    Raises:
        ValueError: it is missing or leads elsewhere; names the file.
    """
    folder = frame_folder(dataset, frame_index)
    path = folder / name
    if path.is_symlink() or path.resolve().parent != folder.resolve():
        raise ValueError(f"{path}: leads outside the frame's folder")
    if not path.is_file():
        raise ValueError(f"{path}: is missing")
    return path


def link_or_copy(source: Path, target: Path) -> None:
    """The file once more under another name: without taking room where the disk can do so, else as a copy.

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


def place_image(source: Dataset, frame_index: int, eye: Eye, target: Path, log: ExportLog) -> None:
    """One eye's image for programs that take 8 bits a sample.

    Args:
        source: the dataset.
        frame_index: which pair.
        eye: which image.
        target: the PNG to make: a link or a copy, or the upper 8 of 12 bits.
        log: is told of bits that are left out.

    Raises:
        ValueError: the image is missing or damaged; names the file.
        OSError: it cannot be written.
    """
    name, bits = image_file(eye), source.manifest.recipe.sensor.output_bits
    path = frame_file(source.path, frame_index, name)
    if bits == 8:
        link_or_copy(path, target)
        return
    pixels = decode_png(read_frame_bytes(source.path, frame_index, name), str(path)) >> (bits - 8)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(encode_png(pixels.astype(np.uint8)))
    log.lost(f"images of {bits} bits: written with their upper 8")
