"""A dataset as navigation may see it: images, time stamps, rig and drogue, without the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.manifest import read_manifest
from datasets_manifest.storage.reader import read_images, read_shutter, read_sought_drogue
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.field_types import Rig
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.images import StereoImages
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import DrogueParameters
from drogue_models.presets import explain
from drogue_models.untrusted_files import parse_json
from geometry.stereo import StereoRig


@dataclass(frozen=True, eq=False)
class BlindPair:
    """One stereo pair.

    Attributes:
        frame_index: index in the dataset.
        images: with time stamp and exposure.
        rig: the cameras.
        drogue: the drogue to look for, which the images may or may not show.
    """

    frame_index: int
    images: StereoImages
    rig: StereoRig
    drogue: DrogueParameters


class BlindIndex(FrozenModel):
    """Description of a dataset without its truth: `blind.json` of a blind export, or an excerpt of a manifest.

    Attributes:
        name: of the dataset.
        rig, sensor: the cameras.
        drogue: the drogue to look for.
        drogues_differ: whether each pair has a drogue of its own instead.
        frames: indices of the pairs, ascending.
    """

    schema_version: Literal[1] = 1
    name: str
    rig: Rig
    sensor: Sensor
    drogue: DrogueParameters
    drogues_differ: bool
    frames: tuple[Annotated[int, Field(ge=0)], ...]


def read_blind_index(dataset: Location) -> BlindIndex:
    """The blind index of a dataset, from `blind.json` or from the manifest.

    Raises:
        ValueError: no such folder, or neither a manifest nor an index that can be trusted; names the file.
    """
    storage = open_storage(dataset)
    path = storage.where(BLIND_FILE)
    if not storage.exists(BLIND_FILE):
        manifest = read_manifest(dataset)
        return BlindIndex(
            name=manifest.name,
            rig=manifest.recipe.rig,
            sensor=manifest.recipe.sensor,
            drogue=manifest.recipe.drogue,
            drogues_differ=bool(manifest.recipe.variants),
            frames=tuple(sorted(entry.frame_index for entry in manifest.frames)),
        )
    try:
        return BlindIndex.model_validate(parse_json(storage.read(BLIND_FILE)))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise ValueError(f"{path}: {explain(error)}") from error
    except ValueError as error:
        raise ValueError(f"{path}: is truncated or not JSON: {error}") from error


class BlindDataset:
    """Stereo pairs without their truth; images are read on demand.

    Attributes:
        rig: the cameras of all pairs.
        drogue: the drogue to look for, unless each pair has one of its own.
        frame_indices: of the pairs, ascending.
    """

    def __init__(self, path: Location) -> None:
        """Open the dataset in a folder, or at a URL such as `s3://bucket/name`.

        Raises:
            ValueError: no such place, or nothing in it that can be trusted.
        """
        index = read_blind_index(path)
        self._frames = FrameStore(path)
        self.rig: StereoRig = index.rig
        self.drogue: DrogueParameters = index.drogue
        self._has_variants = index.drogues_differ
        self._sensor = index.sensor
        self.frame_indices: tuple[int, ...] = index.frames

    def pair(self, frame_index: int) -> BlindPair:
        """One stereo pair.

        Raises:
            ValueError: it is missing, truncated or of another size or depth than the rig's; names the file.
        """
        shutter = read_shutter(self._frames, frame_index)
        images = read_images(self._frames, frame_index, self.rig.camera, self._sensor, shutter)
        return BlindPair(frame_index, images, self.rig, self.sought_drogue(frame_index))

    def sought_drogue(self, frame_index: int) -> DrogueParameters:
        """The drogue to look for in a pair, which the pair may or may not show.

        Raises:
            ValueError: the pair's record is missing, truncated or wrong; names the file.
        """
        return read_sought_drogue(self._frames, frame_index, self.drogue) if self._has_variants else self.drogue
