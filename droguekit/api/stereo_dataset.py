"""Datasets as sequences of stereo pairs; images, truth, masks and depths are read when they are asked for."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol, overload

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.image_codecs import read_passes
from datasets_manifest.storage.layout import BLIND_FILE, passes_file
from datasets_manifest.storage.reader import Dataset, read_sought_drogue
from datasets_manifest.storage.storage import Location, as_location, open_storage
from datasets_manifest.types.images import Pixels, StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import drogue_part_ids
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye, StereoRig

Split = Literal["train", "val", "test"]


class PairContents(Protocol):
    """Where the contents of a stereo pair come from: files, or a renderer."""

    def images(self) -> StereoImages:
        """Both images."""
        ...

    def record(self) -> PairRecord:
        """The truth."""
        ...

    def part_id(self, eye: Eye) -> NDArray[np.uint8]:
        """(H, W) part id of every pixel centre."""
        ...

    def depth_m(self, eye: Eye) -> NDArray[np.float32]:
        """(H, W) planar depth of every pixel centre. [m]"""
        ...


class StereoPair:
    """One stereo pair with its truth. Every part is read at its first use and kept.

    Pairs are equal where they are the same pair of the same dataset.

    Attributes:
        frame_index: in the dataset or in the recipe.
        rig: the cameras.
        drogue: the drogue to look for, which the images may or may not show.
    """

    def __init__(self, frame_index: int, rig: StereoRig, drogue: DrogueParameters, source: PairContents) -> None:
        """A pair whose contents come from `source`."""
        self.frame_index, self.rig, self.drogue = frame_index, rig, drogue
        self._source = source

    def __repr__(self) -> str:
        """Name and frame."""
        return f"StereoPair(frame_index={self.frame_index})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StereoPair) and self._source == other._source

    def __hash__(self) -> int:
        return hash(self._source)

    @cached_property
    def images(self) -> StereoImages:
        """Both images with time stamp, exposure, bits and encoding.

        Raises:
            ValueError: a file is missing or damaged; names it.
        """
        return self._source.images()

    @property
    def left(self) -> Pixels:
        """(H, W, 3) left image, red, green, blue, or (H, W) of a mono sensor; uint8, or 12 bits in uint16."""
        return self.images.left

    @property
    def right(self) -> Pixels:
        """The right image; see `left`."""
        return self.images.right

    @cached_property
    def record(self) -> PairRecord:
        """All labels of the pair.

        Raises:
            ValueError: the dataset has no truth, or the file is missing or damaged; names it.
        """
        return self._source.record()

    @property
    def truth(self) -> RigidTransform | None:
        """`left_from_drogue` at mid-exposure [m], or None in a pair without a drogue.

        Raises:
            ValueError: as `record`.
        """
        return self.record.left_from_drogue

    @cached_property
    def part_ids(self) -> Mapping[Eye, NDArray[np.uint8]]:
        """(H, W) part id of every pixel centre, by eye; the ids are those of `drogue_models.parts`.

        Raises:
            ValueError: as `record`.
        """
        return {eye: self._source.part_id(eye) for eye in EYES}

    @cached_property
    def masks(self) -> Mapping[Eye, NDArray[np.bool_]]:
        """(H, W) by eye, where pixel centres see the drogue.

        Raises:
            ValueError: as `record`.
        """
        ids = drogue_part_ids(marker_layout(self.drogue).count)
        return {eye: np.isin(parts, ids) for eye, parts in self.part_ids.items()}

    @cached_property
    def depth_m(self) -> Mapping[Eye, NDArray[np.float32]]:
        """(H, W) planar depth of every pixel centre by eye, inf for the sky. [m]

        Raises:
            ValueError: as `record`, or the dataset was rendered without depths (`[outputs] exr = true` stores them).
        """
        return {eye: self._source.depth_m(eye) for eye in EYES}


@dataclass(frozen=True)
class _StoredPair:
    """A pair of a dataset on disk."""

    dataset: Dataset = field(compare=False)
    path: Location
    frame_index: int

    def images(self) -> StereoImages:
        return self.dataset.images(self.frame_index)

    def record(self) -> PairRecord:
        return self.dataset.record(self.frame_index)

    def part_id(self, eye: Eye) -> NDArray[np.uint8]:
        return self.dataset.part_ids(self.frame_index, eye)

    def depth_m(self, eye: Eye) -> NDArray[np.float32]:
        # A hostile file could harm the decoder: only what the record describes is read.
        _, files = self.dataset.whole_frame(self.frame_index)
        name = passes_file(eye)
        where = self.dataset.frames.where(self.frame_index, name)
        if name not in files:
            raise ValueError(f"{where}: is missing; render with `[outputs] exr = true` in the recipe to store depths")
        return read_passes(files[name], where, self.dataset.manifest.recipe.rig.camera)["depth.Z"]


def stored_pair(dataset: Dataset, frame_index: int) -> StereoPair:
    """A pair of a dataset with truth.

    Raises:
        ValueError: its record is missing or damaged; names the file.
    """
    recipe = dataset.manifest.recipe
    drogue = recipe.drogue
    if recipe.variants:
        drogue = read_sought_drogue(dataset.frames, frame_index, recipe.drogue)
    return StereoPair(frame_index, recipe.rig, drogue, _StoredPair(dataset, dataset.path, frame_index))


@dataclass(frozen=True)
class _BlindSource:
    """A pair of a dataset without truth."""

    dataset: BlindDataset = field(compare=False)
    path: str
    frame_index: int

    def images(self) -> StereoImages:
        return self.dataset.pair(self.frame_index).images

    def record(self) -> PairRecord:
        raise self._no_truth()

    def part_id(self, eye: Eye) -> NDArray[np.uint8]:
        raise self._no_truth()

    def depth_m(self, eye: Eye) -> NDArray[np.float32]:
        raise self._no_truth()

    def _no_truth(self) -> ValueError:
        return ValueError(f"{self.path}: is a blind dataset: it has images, rig and drogue, but no truth")


class StereoDataset(Sequence[StereoPair]):
    """Stereo pairs, in ascending order of their frame indices or in the order of the selection.

    A dataset is small to pickle, so that data loaders may send it to their processes.

    Attributes:
        path: folder or URL.
        frame_indices: of the pairs, in ascending order, or in the order of the selection.
    """

    def __init__(self, path: str | Path, frame_indices: Iterable[int] | None = None) -> None:
        """Open the dataset in a folder, or at a URL such as `s3://bucket/name`.

        Args:
            path: folder or URL.
            frame_indices: keep only these pairs, in this order; all of them when None.

        Raises:
            ValueError: no such place, nothing in it that can be trusted, or a pair that it does not have.
            TypeError: an index of a pair that is no whole number.
        """
        self.path = str(path)
        location = as_location(path) if isinstance(path, str) else path
        self._blind = BlindDataset(location)
        self._dataset = None if open_storage(location).exists(BLIND_FILE) else Dataset(location)
        known = self._blind.frame_indices
        chosen = known if frame_indices is None else map(operator.index, frame_indices)
        self.frame_indices: tuple[int, ...] = tuple(dict.fromkeys(chosen))
        unknown = sorted(self._positions - set(known))
        if unknown:
            raise ValueError(f"{self.path}: has no pair {unknown[0]}")

    def __repr__(self) -> str:
        """Place and number of pairs."""
        return f"StereoDataset({self.path!r}, {len(self)} pairs)"

    def __reduce__(self) -> tuple[type[StereoDataset], tuple[str, tuple[int, ...]]]:
        """Place and pairs; another process opens the dataset again."""
        return type(self), (self.path, self.frame_indices)

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.frame_indices)

    def __iter__(self) -> Iterator[StereoPair]:
        """The pairs one after the other."""
        return map(self.frame, self.frame_indices)

    @overload
    def __getitem__(self, index: int) -> StereoPair: ...
    @overload
    def __getitem__(self, index: slice) -> StereoDataset: ...
    def __getitem__(self, index: int | slice) -> StereoPair | StereoDataset:
        """The pair at a position, or the dataset of a slice.

        Raises:
            IndexError: no such position.
        """
        if isinstance(index, slice):
            return StereoDataset(self.path, self.frame_indices[index])
        return self.frame(self.frame_indices[index])

    @property
    def rig(self) -> StereoRig:
        """The cameras."""
        return self._blind.rig

    @property
    def drogue(self) -> DrogueParameters:
        """The drogue of the recipe; pairs of a dataset with several drogues have their own, see `StereoPair.drogue`."""
        return self._blind.drogue

    @property
    def reader(self) -> Dataset:
        """The reader of the dataset's files, for what pairs do not offer, such as the manifest.

        Raises:
            ValueError: the dataset has no truth.
        """
        if self._dataset is None:
            raise ValueError(f"{self.path}: is a blind dataset: it has images, rig and drogue, but no truth")
        return self._dataset

    @property
    def has_truth(self) -> bool:
        """Whether pairs have records, masks and depths."""
        return self._dataset is not None

    def frame(self, frame_index: int) -> StereoPair:
        """The pair of a frame index.

        Raises:
            ValueError: this dataset, or this part of it, has no such frame; or its record is damaged.
            TypeError: the index is no whole number.
        """
        frame_index = operator.index(frame_index)
        if frame_index not in self._positions:
            raise ValueError(f"{self.path}: has no pair {frame_index}")
        if self._dataset is not None:
            return stored_pair(self._dataset, frame_index)
        source = _BlindSource(self._blind, self.path, frame_index)
        return StereoPair(frame_index, self.rig, self._blind.sought_drogue(frame_index), source)

    @cached_property
    def _positions(self) -> frozenset[int]:
        return frozenset(self.frame_indices)

    def select(
        self,
        *,
        distance_m: tuple[float, float] | None = None,
        family: str | None = None,
        split: Split | None = None,
        with_drogue: bool | None = None,
    ) -> StereoDataset:
        """The pairs that meet every condition that is given.

        Args:
            distance_m: least and largest distance, both included; pairs without a drogue do not have one. [m]
            family: name of the recipe's family.
            split: `train`, `val` or `test`.
            with_drogue: True for pairs that show a drogue, False for those without.

        Raises:
            ValueError: the dataset has no truth, distances that do not ascend, a split or family that it cannot have,
                or a damaged record.
        """
        if distance_m is not None and not distance_m[0] <= distance_m[1]:
            raise ValueError(f"distance_m: must be the least and the largest distance, got {distance_m}")
        manifest = self.reader.manifest
        families = [each.name for each in manifest.recipe.families] or [manifest.recipe.family]
        if family is not None and family not in families:
            raise ValueError(f"family: must be one of {', '.join(families)}, got {family!r}")
        if split is not None and split not in ("train", "val", "test"):
            raise ValueError(f"split: must be train, val or test, got {split!r}")
        entries = {entry.frame_index: entry for entry in manifest.frames}
        kept = [
            index
            for index in self.frame_indices
            if (split is None or entries[index].split == split)
            and (with_drogue is None or entries[index].empty != with_drogue)
        ]
        if distance_m is not None or family is not None:
            kept = [index for index in kept if self._meets(index, distance_m, family)]
        return StereoDataset(self.path, kept)

    def _meets(self, frame_index: int, distance_m: tuple[float, float] | None, family: str | None) -> bool:
        conditions = self.frame(frame_index).record.conditions
        if family is not None and conditions.family != family:
            return False
        if distance_m is None:
            return True
        return conditions.distance_m is not None and distance_m[0] <= conditions.distance_m <= distance_m[1]


def open_dataset(path: str | Path) -> StereoDataset:
    """Open a dataset for reading: rendered, imported, or blind.

    Args:
        path: folder, or a URL such as `s3://bucket/name`.

    Raises:
        ValueError: no such place, or nothing in it that can be trusted.
    """
    return StereoDataset(path)
