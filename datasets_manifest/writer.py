"""Stereo pairs onto the disk: a frame's folder appears whole, by one rename, or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import PART_SUFFIX, part_path, sync_folder, write_text_atomic
from datasets_manifest.images import Pixels, StereoImages
from datasets_manifest.layout import RECORD_FILE, frame_folder, image_file, mosaic_file, parts_file
from datasets_manifest.png import encode_png
from datasets_manifest.records import PairRecord
from geometry.stereo import Eye

__all__ = ["encode_files", "remove_leftovers", "write_frame", "write_text_atomic"]


def encode_files(images: StereoImages, part_ids: Mapping[Eye, NDArray[np.uint8]]) -> dict[str, bytes]:
    """The PNG files of one stereo pair.

    Args:
        images: what the cameras saw, with the mosaics of a Bayer sensor.
        part_ids: per eye, (H, W) part ids.

    Returns:
        File contents by file name.

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
        files[parts_file(eye)] = encode_png(parts, of_areas=True)
        if mosaic is not None:
            files[mosaic_file(eye)] = encode_png(mosaic)
    return files


def canonical_json(value: Any) -> str:
    """One line of JSON that is a function of the value alone: sorted keys, shortest floats that read back the same.

    Raises:
        ValueError: a number that is not finite.
    """
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)


def encode_record(record: PairRecord) -> bytes:
    """The bytes of `record.json`."""
    return (canonical_json(record.model_dump(mode="json")) + "\n").encode()


def write_frame(dataset: Path, record: PairRecord, files: Mapping[str, bytes]) -> PairRecord:
    """Put one stereo pair into a dataset; a frame of that index that is there already is replaced.

    Args:
        dataset: the dataset's folder; made if missing.
        record: the truth; its `file_sha256` is filled in here.
        files: contents by plain file name.

    Returns:
        The record as it stands on disk.

    Raises:
        ValueError: a file name that is not plain.
        OSError: the disk is full or cannot be written. Nothing half-written is left.
    """
    for name in files:
        if not is_plain_name(name) or name == RECORD_FILE:
            raise ValueError(f"files: must have plain names other than {RECORD_FILE}, got {name!r}")
    hashes = {name: hashlib.sha256(files[name]).hexdigest() for name in sorted(files)}
    complete = record.model_copy(update={"file_sha256": hashes})
    target = frame_folder(dataset, record.frame_index)
    part = part_path(target)
    try:
        part.mkdir(parents=True)
        for name in sorted(files):
            _write_synced(part / name, files[name])
        _write_synced(part / RECORD_FILE, encode_record(complete))
        sync_folder(part)
        remove_frame(dataset, record.frame_index)
        part.rename(target)
        sync_folder(target.parent)
    except OSError as error:
        raise OSError(error.errno, f"{target}: cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return complete


def remove_frame(dataset: Path, frame_index: int) -> None:
    """Take a frame out of a dataset, if it is there, by one rename before anything in it is deleted.

    Raises:
        OSError: it cannot be removed.
    """
    target = frame_folder(dataset, frame_index)
    if not target.exists():
        return
    grave = part_path(target)
    target.rename(grave)
    shutil.rmtree(grave)


def leftovers(dataset: Path) -> list[Path]:
    """What runs that were killed have left half-written, sorted."""
    folders = [dataset, *(entry for entry in _entries(dataset) if entry.is_dir() and entry.name[0] != ".")]
    return sorted(
        entry
        for folder in folders
        for entry in _entries(folder)
        if entry.name.startswith(".") and entry.name.endswith(PART_SUFFIX)
    )


def remove_leftovers(dataset: Path) -> list[Path]:
    """Delete what killed runs have left half-written; only while nobody else writes into the dataset.

    Returns:
        What was deleted.

    Raises:
        OSError: something cannot be deleted; one line that names it.
    """
    found = leftovers(dataset)
    for entry in found:
        try:
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
        except OSError as error:
            raise OSError(error.errno, f"{entry}: cannot be removed: {error.strerror}") from error
    return found


def is_plain_name(name: str) -> bool:
    """Whether a file name stays in its folder on every system."""
    return name not in ("", ".", "..") and not any(character in name for character in "/\\:\0")


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _write_synced(path: Path, data: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
