"""A dataset's folder, read as it is asked for."""

from __future__ import annotations

import hashlib
import json
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from datasets_manifest.frame import Sensor
from datasets_manifest.images import Pixels, StereoImages
from datasets_manifest.json_types import write_rig
from datasets_manifest.layout import RECORD_FILE, frame_folder, image_file, mosaic_file, parts_file
from datasets_manifest.manifest import Manifest, read_manifest
from datasets_manifest.png import decode_png
from datasets_manifest.records import PairRecord
from datasets_manifest.writer import is_plain_name
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import explain
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, Eye


class Shutter(NamedTuple):
    """What a pair's record says of its images besides the truth."""

    time_s: float
    exposure_s: float
    black_level_dn: float


class Dataset:
    """Stereo pairs with their truth; nothing but the manifest is read before it is asked for."""

    def __init__(self, path: Path) -> None:
        """Open the dataset in a folder.

        Raises:
            ValueError: no such folder, or no manifest that can be trusted.
        """
        self.path = path
        self.manifest: Manifest = read_manifest(path)

    @cached_property
    def frame_indices(self) -> tuple[int, ...]:
        """Indices of the pairs, ascending."""
        return tuple(sorted(entry.frame_index for entry in self.manifest.frames))

    @cached_property
    def _rig_table(self) -> dict[str, Any]:
        return write_rig(self.manifest.recipe.rig)

    def record(self, frame_index: int) -> PairRecord:
        """The truth of one pair.

        Raises:
            ValueError: the pair is missing, or its record is truncated or wrong; names the file.
        """
        path = frame_folder(self.path, frame_index) / RECORD_FILE
        table = read_record_table(self.path, frame_index)
        try:
            record = PairRecord.model_validate(table)
        except ValidationError as error:
            raise ValueError(f"{path}: {explain(error)}") from error
        if record.frame_index != frame_index:
            raise ValueError(f"{path}: frame_index: must be {frame_index}, got {record.frame_index}")
        if write_rig(record.frame.rig) != self._rig_table:
            raise ValueError(f"{path}: frame.rig: differs from that of the dataset's recipe")
        for name in record.file_sha256:
            if not is_plain_name(name):
                raise ValueError(f"{path}: file_sha256: must name files of the frame's own folder, got {name!r}")
        return record

    def images(self, frame_index: int) -> StereoImages:
        """What the cameras saw.

        Raises:
            ValueError: a file is missing, truncated or of another size or depth than the rig's; names the file.
        """
        recipe = self.manifest.recipe
        shutter = read_shutter(self.path, frame_index)
        return read_images(frame_folder(self.path, frame_index), recipe.rig.camera, recipe.sensor, shutter)

    def part_ids(self, frame_index: int, eye: Eye) -> NDArray[np.uint8]:
        """(H, W) part id of every pixel centre.

        Raises:
            ValueError: the file is missing, truncated or of another size than the rig's; names the file.
        """
        folder = frame_folder(self.path, frame_index)
        return cast(NDArray[np.uint8], _read_gray(folder, parts_file(eye), self.manifest.recipe.rig.camera, np.uint8))

    def verify(self, frame_index: int) -> list[str]:
        """Hash a pair's files again.

        Returns:
            What is wrong, one line for each file; empty if nothing is.
        """
        folder = frame_folder(self.path, frame_index)
        expected = next((e.record_sha256 for e in self.manifest.frames if e.frame_index == frame_index), None)
        if expected is None:
            return [f"{folder}: is not in the manifest"]
        faults = _hash_faults(folder, RECORD_FILE, expected)
        try:
            hashes = self.record(frame_index).file_sha256
        except ValueError as error:
            return [*faults, str(error)]
        for name, want in hashes.items():
            faults += _hash_faults(folder, name, want)
        return faults


def read_frame_bytes(dataset: Path, frame_index: int, name: str) -> bytes:
    """The contents of a file of a pair.

    Raises:
        ValueError: it is missing, leads elsewhere or cannot be read; names the file.
    """
    return _read_bytes(frame_folder(dataset, frame_index), name)


def read_record_table(dataset: Path, frame_index: int) -> dict[str, Any]:
    """The JSON object in a pair's record, unchecked.

    Raises:
        ValueError: it is missing, truncated or no JSON object; names the file.
    """
    folder = frame_folder(dataset, frame_index)
    path = folder / RECORD_FILE
    try:
        table = json.loads(_read_bytes(folder, RECORD_FILE))
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error
    if not isinstance(table, dict):
        raise ValueError(f"{path}: must hold a JSON object")
    return table


def read_shutter(dataset: Path, frame_index: int) -> Shutter:
    """Time stamp, exposure and black level of a pair's images; no truth is looked at.

    Raises:
        ValueError: the record is missing or truncated, or lacks them; names the file.
    """
    table = read_record_table(dataset, frame_index)
    try:
        values = table["time_s"], table["frame"]["exposure"]["time_s"], table.get("image_black_level_dn", 0.0)
        return Shutter(*(float(value) for value in values))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{frame_folder(dataset, frame_index) / RECORD_FILE}: no valid time_s or exposure") from error


def read_sought(dataset: Path, frame_index: int, usual: DrogueParameters) -> DrogueParameters:
    """The drogue that a receiver would look for in a pair; whether it is there is not told.

    Args:
        dataset: folder.
        frame_index: which pair.
        usual: the recipe's drogue, for datasets with one.

    Raises:
        ValueError: the record is missing, truncated or wrong; names the file.
    """
    frame = read_record_table(dataset, frame_index).get("frame")
    given = (frame.get("drogue") or frame.get("sought")) if isinstance(frame, dict) else None
    if given is None:
        return usual
    try:
        return DrogueParameters.model_validate(given)
    except ValidationError as error:
        path = frame_folder(dataset, frame_index) / RECORD_FILE
        raise ValueError(f"{path}: drogue: {explain(error)}") from error


def read_images(folder: Path, camera: PinholeCamera, sensor: Sensor, shutter: Shutter) -> StereoImages:
    """A pair's images from its folder.

    Raises:
        ValueError: a file is missing, truncated or of another size or depth than camera and sensor give.
    """
    dtype = np.uint8 if sensor.output_bits == 8 else np.uint16
    pixels: dict[Eye, Pixels] = {}
    mosaics: dict[Eye, Pixels | None] = {"left": None, "right": None}
    for eye in EYES:
        if sensor.color == "mono":
            pixels[eye] = _read_gray(folder, image_file(eye), camera, dtype)
        else:
            pixels[eye] = _read(folder, image_file(eye), (camera.height_px, camera.width_px, 3), dtype)
        if sensor.color == "bayer":
            mosaics[eye] = _read_gray(folder, mosaic_file(eye), camera, dtype)
    return StereoImages(
        left=pixels["left"],
        right=pixels["right"],
        time_s=shutter.time_s,
        exposure_s=shutter.exposure_s,
        bits=sensor.output_bits,
        encoding=sensor.encoding,
        black_level_dn=shutter.black_level_dn,
        left_mosaic=mosaics["left"],
        right_mosaic=mosaics["right"],
    )


def _read_gray(folder: Path, name: str, camera: PinholeCamera, dtype: type[np.unsignedinteger[Any]]) -> Pixels:
    return _read(folder, name, (camera.height_px, camera.width_px), dtype)


def _read(folder: Path, name: str, shape: tuple[int, ...], dtype: type[np.unsignedinteger[Any]]) -> Pixels:
    image = decode_png(_read_bytes(folder, name), str(folder / name))
    if image.shape != shape or image.dtype != dtype:
        raise ValueError(
            f"{folder / name}: must be {shape} of {np.dtype(dtype).name}, got {image.shape} of {image.dtype}"
        )
    return image


def _read_bytes(folder: Path, name: str) -> bytes:
    """A file of a frame, which must lie in its folder itself and not behind a link.

    Raises:
        ValueError: it is missing, leads elsewhere or cannot be read.
    """
    path = folder / name
    try:
        if path.resolve().parent != folder.resolve():
            raise ValueError(f"{path}: leads outside the frame's folder")
        return path.read_bytes()
    except FileNotFoundError as error:
        raise ValueError(f"{path}: is missing") from error
    except (OSError, RuntimeError) as error:
        raise ValueError(f"{path}: cannot be read: {error}") from error


def _hash_faults(folder: Path, name: str, expected: str) -> list[str]:
    try:
        digest = hashlib.sha256(_read_bytes(folder, name)).hexdigest()
    except ValueError as error:
        return [str(error)]
    return [] if digest == expected else [f"{folder / name}: was changed, its hash is not the one on record"]
