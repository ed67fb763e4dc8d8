"""Where the pairs of a page come from: a dataset with its truth, or one without, such as imported flight data."""

from __future__ import annotations

import hashlib
from functools import cached_property
from typing import Any, NamedTuple, Protocol

from datasets_manifest.storage.blind import BlindDataset, read_blind_index
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import BLIND_FILE, image_file
from datasets_manifest.storage.manifest import FrameEntry as ManifestEntry
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.images import StereoImages
from droguekit.visualization.browse.drogue_rings import drogue_rings
from droguekit.visualization.browse.frame_entry import FrameEntry, blind_entry, frame_entry
from geometry.stereo import EYES, StereoRig


class DatasetFacts(NamedTuple):
    """What stands at the top of the page, and the cameras.

    Attributes:
        facts: sentences on what is in the dataset.
        is_blind: it has no truth.
    """

    name: str
    facts: tuple[str, ...]
    rig: StereoRig
    is_blind: bool


class PairSource(Protocol):
    """Pairs by their index; may be pickled for another process."""

    def facts(self) -> DatasetFacts:
        """What is to be said of the whole."""
        ...

    def frame_indices(self) -> tuple[int, ...]:
        """Of the pairs, ascending."""
        ...

    def entry(self, frame_index: int) -> FrameEntry:
        """What the page says of a pair; `ValueError` where it cannot be read."""
        ...

    def images(self, frame_index: int) -> StereoImages:
        """What the cameras saw; `ValueError` where it cannot be read."""
        ...


def open_source(dataset: Location) -> PairSource:
    """The pairs of a dataset.

    Raises:
        ValueError: no dataset there, or one that cannot be trusted.
    """
    source: PairSource = BlindPairs(dataset) if open_storage(dataset).exists(BLIND_FILE) else TruePairs(dataset)
    source.frame_indices()
    return source


class _Opened:
    """Opens the dataset when it is asked for, in each process anew."""

    def __init__(self, dataset: Location) -> None:
        self._place = dataset

    def __getstate__(self) -> dict[str, Any]:
        return {"_place": self._place}


class TruePairs(_Opened):
    """Pairs with their truth."""

    @cached_property
    def _dataset(self) -> Dataset:
        return Dataset(self._place)

    @cached_property
    def _known(self) -> dict[int, ManifestEntry]:
        return {entry.frame_index: entry for entry in self._dataset.manifest.frames}

    def facts(self) -> DatasetFacts:
        """From the manifest."""
        manifest = self._dataset.manifest
        counts = f"{manifest.counts.pairs} stereo pairs, {manifest.counts.empty} of them without a drogue."
        origin = f"Content hash {manifest.dataset_sha256}; data under {manifest.data_licence}."
        facts = tuple(filter(None, (manifest.recipe.description, counts, origin)))
        return DatasetFacts(manifest.name, facts, manifest.recipe.rig, False)

    def frame_indices(self) -> tuple[int, ...]:
        """Of the manifest."""
        return self._dataset.frame_indices

    def entry(self, frame_index: int) -> FrameEntry:
        """From its record."""
        known, record = self._known[frame_index], self._dataset.record(frame_index)
        drogue = self._dataset.drogue_sought(record)
        return frame_entry(record, drogue, known.split, known.record_sha256)

    def images(self, frame_index: int) -> StereoImages:
        """Decoded, if they are those on record: its hash stands for them in the names of the pictures."""
        frames, hashes = self._dataset.frames, self._dataset.record(frame_index).file_sha256
        for name in map(image_file, EYES):
            if hashlib.sha256(frames.read(frame_index, name)).hexdigest() != hashes.get(name):
                where = frames.where(frame_index, name)
                raise ValueError(f"{where}: was changed, its hash is not the one on record")
        return self._dataset.images(frame_index)


class BlindPairs(_Opened):
    """Pairs without truth."""

    @cached_property
    def _dataset(self) -> BlindDataset:
        return BlindDataset(self._place)

    @cached_property
    def _frames(self) -> FrameStore:
        return FrameStore(self._place)

    def facts(self) -> DatasetFacts:
        """From the index."""
        index = read_blind_index(self._place)
        return DatasetFacts(index.name, (f"{len(index.frames)} stereo pairs without truth.",), index.rig, True)

    def frame_indices(self) -> tuple[int, ...]:
        """Of the index."""
        return self._dataset.frame_indices

    def entry(self, frame_index: int) -> FrameEntry:
        """Of the pair's time and drogue; its images' own hash stands for them."""
        pixels = hashlib.sha256()
        for eye in EYES:
            pixels.update(self._frames.read(frame_index, image_file(eye)))
        pair = self._dataset.pair(frame_index)
        return blind_entry(frame_index, pair.images.time_s, drogue_rings(pair.drogue), pixels.hexdigest())

    def images(self, frame_index: int) -> StereoImages:
        """Decoded."""
        return self._dataset.pair(frame_index).images
