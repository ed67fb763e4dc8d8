"""Reads datasets: truth, images and part ids, each on demand."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.image_codecs import decode_png
from datasets_manifest.storage.layout import RECORD_FILE, image_file, is_plain_name, mosaic_file, parts_file
from datasets_manifest.storage.manifest import Manifest, read_manifest
from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.field_types import read_rig, write_rig
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.images import Pixels, StereoImages
from datasets_manifest.types.records import MOST_TIME_S, PairRecord
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import explain
from drogue_models.untrusted_files import parse_json
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, Eye, StereoRig


class Shutter(NamedTuple):
    """Metadata of a pair's images that is no truth."""

    time_s: float
    exposure_s: float
    black_level_dn: float


class Dataset:
    """Stereo pairs with their truth; all but the manifest is read on demand."""

    def __init__(self, path: Location) -> None:
        """Open the dataset in a folder, or at a URL such as `s3://bucket/name`.

        Raises:
            ValueError: no such place, or no manifest that can be trusted.
        """
        self.path = path
        self.frames = FrameStore(path)
        self.manifest: Manifest = read_manifest(path)
        # Callers ask for a pair's record, images and hashes in turn, and to parse a record takes longest of all.
        self._latest: tuple[int, bytes, PairRecord] | None = None

    @cached_property
    def frame_indices(self) -> tuple[int, ...]:
        """Indices of the pairs, ascending."""
        return tuple(sorted(entry.frame_index for entry in self.manifest.frames))

    @cached_property
    def _record_hashes(self) -> dict[int, str]:
        return {entry.frame_index: entry.record_sha256 for entry in self.manifest.frames}

    @cached_property
    def _rig_table(self) -> dict[str, Any]:
        return write_rig(self.manifest.recipe.rig)

    @cached_property
    def _rig(self) -> StereoRig:
        """The rig as every record gives it; they share it."""
        return read_rig(self._rig_table)

    def record(self, frame_index: int) -> PairRecord:
        """The truth of one pair.

        Raises:
            ValueError: the pair is missing, or its record is truncated or wrong; names the file.
        """
        return self._parse_record(frame_index, self.frames.read(frame_index, RECORD_FILE))

    def records(self, faults: PairFaults | None = None) -> Iterator[PairRecord]:
        """The truth of all pairs in the order of their indices.

        Args:
            faults: count pairs whose record is damaged or changed, which are left out; without, such a pair is an
                error.

        Raises:
            ValueError: a record cannot be read or was changed, and nothing counts faults; names the file.
        """
        for frame_index in self.frame_indices:
            record = read_or_note(frame_index, self.unchanged_record, faults)
            if record is not None:
                yield record

    def sought_drogue(self, record: PairRecord) -> DrogueParameters:
        """The drogue that navigation looks for in a pair, whether the pair shows it or not."""
        return record.frame.drogue or record.frame.sought or self.manifest.recipe.drogue

    def _parse_record(self, frame_index: int, data: bytes) -> PairRecord:
        known = self._known_record(frame_index, data)
        if known is not None:
            return known
        path = self.frames.where(frame_index, RECORD_FILE)
        table = _parse_table(data, path)
        frame = table.get("frame")
        if isinstance(frame, dict) and frame.get("rig") == self._rig_table:
            frame["rig"] = self._rig
        try:
            record = PairRecord.model_validate(table)
        except ValidationError as error:
            raise ValueError(f"{path}: {explain(error)}") from error
        if record.frame_index != frame_index:
            raise ValueError(f"{path}: frame_index: must be {frame_index}, got {record.frame_index}")
        if record.frame.rig is not self._rig and write_rig(record.frame.rig) != self._rig_table:
            raise ValueError(f"{path}: frame.rig: differs from that of the dataset's recipe")
        for name in record.file_sha256:
            if not is_plain_name(name):
                raise ValueError(f"{path}: file_sha256: must name files of the frame's own folder, got {name!r}")
        self._latest = (frame_index, data, record)
        return record

    def _known_record(self, frame_index: int, data: bytes) -> PairRecord | None:
        """The latest record, if it is that pair's and its file has not changed."""
        # Another thread may replace it meanwhile.
        latest = self._latest
        return latest[2] if latest is not None and latest[:2] == (frame_index, data) else None

    def whole_frame(self, frame_index: int) -> tuple[PairRecord, dict[str, bytes]]:
        """The record of a pair, and its other files by name, each read once and checked against its hash.

        Raises:
            ValueError: a file is missing, or its hash is not the recorded one; names it.
        """
        data = self.frames.read(frame_index, RECORD_FILE)
        self._check_hash(frame_index, RECORD_FILE, data, self._record_hashes[frame_index])
        record = self._parse_record(frame_index, data)
        files: dict[str, bytes] = {}
        for name, expected in record.file_sha256.items():
            files[name] = self.frames.read(frame_index, name)
            self._check_hash(frame_index, name, files[name], expected)
        return record, files

    def unchanged_record(self, frame_index: int) -> PairRecord:
        """The truth of one pair whose record is as it was written.

        Raises:
            ValueError: the pair is missing, or its record wrong or changed; names the file.
        """
        expected = self._record_hashes.get(frame_index)
        if expected is None:
            raise ValueError(f"{self.frames.where(frame_index)}: is not in the manifest")
        data = self.frames.read(frame_index, RECORD_FILE)
        # Parsed first, since "truncated" says more than "changed".
        record = self._parse_record(frame_index, data)
        self._check_hash(frame_index, RECORD_FILE, data, expected)
        return record

    def checked_record(self, frame_index: int) -> PairRecord:
        """The truth of one pair whose record and other files are as they were written.

        Raises:
            ValueError: the pair is missing or its record wrong, or a file is missing or changed; names it.
        """
        record = self.unchanged_record(frame_index)
        for name, expected in record.file_sha256.items():
            self._check_hash(frame_index, name, self.frames.read(frame_index, name), expected)
        return record

    def _check_hash(self, frame_index: int, name: str, data: bytes, expected: str) -> None:
        if hashlib.sha256(data).hexdigest() != expected:
            raise ValueError(
                f"{self.frames.where(frame_index, name)}: was changed: its hash differs from the recorded one"
            )

    def images(self, frame_index: int) -> StereoImages:
        """Both images of a pair.

        Raises:
            ValueError: a file is missing, truncated or of another size or depth than the rig's; names the file.
        """
        recipe = self.manifest.recipe
        return read_images(self.frames, frame_index, recipe.rig.camera, recipe.sensor, self.shutter(frame_index))

    def shutter(self, frame_index: int) -> Shutter:
        """Time stamp, exposure and black level of a pair's images, even where the rest of its record is damaged.

        Raises:
            ValueError: the record is missing or truncated, or lacks them; names the file.
        """
        data = self.frames.read(frame_index, RECORD_FILE)
        record = self._known_record(frame_index, data)
        if record is not None:
            return Shutter(record.time_s, record.frame.exposure.time_s, record.image_black_level_dn)
        return _shutter_of(_parse_table(data, self.frames.where(frame_index, RECORD_FILE)), self.frames, frame_index)

    def part_ids(self, frame_index: int, eye: Eye) -> NDArray[np.uint8]:
        """(H, W) part id of every pixel centre.

        Raises:
            ValueError: the file is missing, truncated or of another size than the rig's; names the file.
        """
        camera = self.manifest.recipe.rig.camera
        return cast(NDArray[np.uint8], _read(self.frames, frame_index, parts_file(eye), camera, np.uint8))

    def verify(self, frame_index: int) -> list[str]:
        """Compare a pair's files with their hashes.

        Returns:
            The faults, one line for each file; empty without faults.
        """
        expected = self._record_hashes.get(frame_index)
        if expected is None:
            return [f"{self.frames.where(frame_index)}: is not in the manifest"]
        faults = self._hash_faults(frame_index, RECORD_FILE, expected)
        try:
            hashes = self.record(frame_index).file_sha256
        except ValueError as error:
            return [*faults, str(error)]
        for name, want in hashes.items():
            faults += self._hash_faults(frame_index, name, want)
        return faults

    def _hash_faults(self, frame_index: int, name: str, expected: str) -> list[str]:
        try:
            self._check_hash(frame_index, name, self.frames.read(frame_index, name), expected)
        except ValueError as error:
            return [str(error)]
        return []


def read_record_table(frames: FrameStore, frame_index: int) -> dict[str, Any]:
    """The JSON object in a pair's record, unchecked.

    Raises:
        ValueError: it is missing, truncated or not a JSON object; names the file.
    """
    return _parse_table(frames.read(frame_index, RECORD_FILE), frames.where(frame_index, RECORD_FILE))


def _parse_table(data: bytes, path: str) -> dict[str, Any]:
    try:
        table = parse_json(data)
    except ValueError as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error
    if not isinstance(table, dict):
        raise ValueError(f"{path}: must hold a JSON object")
    return table


def read_shutter(frames: FrameStore, frame_index: int) -> Shutter:
    """Time stamp, exposure and black level of a pair's images, without the truth.

    Raises:
        ValueError: the record is missing or truncated, or lacks them; names the file.
    """
    return _shutter_of(read_record_table(frames, frame_index), frames, frame_index)


def _shutter_of(table: dict[str, Any], frames: FrameStore, frame_index: int) -> Shutter:
    try:
        values = table["time_s"], table["frame"]["exposure"]["time_s"], table.get("image_black_level_dn", 0.0)
        shutter = Shutter(*(float(value) for value in values))
        if not (all(map(math.isfinite, shutter)) and abs(shutter.time_s) < MOST_TIME_S):
            raise ValueError("must be finite")
        return shutter
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{frames.where(frame_index, RECORD_FILE)}: no valid time_s or exposure") from error


def read_sought_drogue(frames: FrameStore, frame_index: int, default: DrogueParameters) -> DrogueParameters:
    """The drogue that navigation is to look for in a pair, whether the pair shows it or not.

    Args:
        frames: of the dataset.
        frame_index: which pair.
        default: the recipe's drogue, for datasets with one.

    Raises:
        ValueError: the record is missing, truncated or wrong; names the file.
    """
    frame = read_record_table(frames, frame_index).get("frame")
    given = (frame.get("drogue") or frame.get("sought")) if isinstance(frame, dict) else None
    if given is None:
        return default
    try:
        return DrogueParameters.model_validate(given)
    except ValidationError as error:
        raise ValueError(f"{frames.where(frame_index, RECORD_FILE)}: drogue: {explain(error)}") from error


def read_images(
    frames: FrameStore, frame_index: int, camera: PinholeCamera, sensor: Sensor, shutter: Shutter
) -> StereoImages:
    """A pair's images.

    Raises:
        ValueError: a file is missing, truncated or of another size or depth than camera and sensor give.
    """
    dtype = np.uint8 if sensor.output_bits == 8 else np.uint16
    pixels: dict[Eye, Pixels] = {}
    mosaics: dict[Eye, Pixels | None] = {"left": None, "right": None}
    for eye in EYES:
        if sensor.color == "mono":
            pixels[eye] = _read(frames, frame_index, image_file(eye), camera, dtype)
        else:
            pixels[eye] = _read(frames, frame_index, image_file(eye), camera, dtype, channels=(3,))
        if sensor.color == "bayer":
            mosaics[eye] = _read(frames, frame_index, mosaic_file(eye), camera, dtype)
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


def _read(
    frames: FrameStore,
    frame_index: int,
    name: str,
    camera: PinholeCamera,
    dtype: type[np.unsignedinteger[Any]],
    channels: tuple[int, ...] = (),
) -> Pixels:
    where, shape = frames.where(frame_index, name), (camera.height_px, camera.width_px, *channels)
    image = decode_png(frames.read(frame_index, name), where, camera)
    if image.shape != shape or image.dtype != dtype:
        raise ValueError(f"{where}: must be {shape} of {np.dtype(dtype).name}, got {image.shape} of {image.dtype}")
    return image
