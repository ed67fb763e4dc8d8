"""Writes stereo pairs and calibrations into a dataset; a frame appears whole or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.calibration.calibration_files import calibration_files
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.layout import (
    CALIBRATION_FOLDER,
    FRAMES_FOLDER,
    RECORD_FILE,
    frame_name,
    image_file,
    is_plain_name,
    mosaic_file,
    parts_file,
)
from datasets_manifest.storage.storage import Location, join, open_storage
from datasets_manifest.types.images import Pixels, StereoImages
from datasets_manifest.types.records import PairRecord
from geometry.stereo import Eye, StereoRig


def encode_files(images: StereoImages, part_ids: Mapping[Eye, NDArray[np.uint8]]) -> dict[str, bytes]:
    """The PNG files of one stereo pair.

    Args:
        images: with the mosaics of a Bayer sensor.
        part_ids: per eye, (H, W) part ids.

    Returns:
        Contents by file name.

    Raises:
        ValueError: part ids of another size than the images, or not uint8.
    """
    eyes: tuple[tuple[Eye, Pixels, Pixels | None], ...] = (
        ("left", images.left, images.left_mosaic),
        ("right", images.right, images.right_mosaic),
    )
    files = {}
    for eye, image, mosaic in eyes:
        parts = part_ids[eye]
        if parts.dtype != np.uint8 or parts.shape != image.shape[:2]:
            raise ValueError(
                f"part_ids[{eye!r}]: must be {image.shape[:2]} of uint8, got {parts.shape} of {parts.dtype}"
            )
        files[image_file(eye)] = encode_png(image)
        files[parts_file(eye)] = encode_png(parts, is_piecewise_constant=True)
        if mosaic is not None:
            files[mosaic_file(eye)] = encode_png(mosaic)
    return files


def canonical_json(value: Any) -> str:
    """JSON on one line that depends on the value alone: sorted keys, shortest floats that read back the same.

    Raises:
        ValueError: a number that is not finite.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)


def encode_record(record: PairRecord) -> bytes:
    """The bytes of `record.json`."""
    return (canonical_json(record.model_dump(mode="json")) + "\n").encode()


def write_frame(dataset: Location, record: PairRecord, files: Mapping[str, bytes]) -> PairRecord:
    """Write one stereo pair into a dataset; an existing frame of that index is replaced.

    Args:
        dataset: its location; a missing folder is made.
        record: the truth; its `file_sha256` is filled in here.
        files: contents by plain file name.

    Returns:
        The record as stored.

    Raises:
        ValueError: a file name that is not plain.
        OSError: the disk is full or cannot be written. Nothing incomplete is left.
    """
    for name in files:
        if not is_plain_name(name) or name == RECORD_FILE:
            raise ValueError(f"files: must have plain names other than {RECORD_FILE}, got {name!r}")
    hashes = {name: hashlib.sha256(files[name]).hexdigest() for name in sorted(files)}
    complete = record.model_copy(update={"file_sha256": hashes})
    together = {**files, RECORD_FILE: encode_record(complete)}
    open_storage(dataset).write_together(frame_name(record.frame_index), together, RECORD_FILE)
    return complete


def remove_frame(dataset: Location, frame_index: int) -> None:
    """Remove a frame's folder from a dataset; it stops counting before any of its files is deleted.

    Raises:
        OSError: it cannot be removed.
    """
    open_storage(dataset).delete_folder(frame_name(frame_index), RECORD_FILE)


def leftovers(dataset: Location) -> list[str]:
    """Paths of incomplete files and folders of killed runs, sorted."""
    storage = open_storage(dataset)
    return [storage.where(name) for name in storage.leftovers(FRAMES_FOLDER, RECORD_FILE)]


def remove_leftovers(dataset: Location) -> list[str]:
    """Delete incomplete files and folders of killed runs; only while no other process writes into the dataset.

    Returns:
        The deleted paths.

    Raises:
        OSError: something cannot be deleted; one line that names it.
    """
    storage = open_storage(dataset)
    found = storage.leftovers(FRAMES_FOLDER, RECORD_FILE)
    for name in found:
        storage.delete(name)
    return [storage.where(name) for name in found]


def write_calibration(dataset: Location, rig: StereoRig) -> list[Location]:
    """Write all calibration files into the dataset's calibration folder.

    Returns:
        Locations of the files, OpenCV's first.

    Raises:
        OSError: they cannot be written.
    """
    storage, files = open_storage(dataset), calibration_files(rig)
    for name, text in files.items():
        storage.write(f"{CALIBRATION_FOLDER}/{name}", text.encode())
    return [join(dataset, f"{CALIBRATION_FOLDER}/{name}") for name in files]
