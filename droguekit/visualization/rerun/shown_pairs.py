"""Pairs to be shown, with their truth where there is one."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, open_storage
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from drogue_models.parameters import DrogueParameters
from geometry.stereo import StereoRig


class ShownPair(NamedTuple):
    """One pair: its images, the rig, the drogue that is there or looked for, and its truth or None."""

    frame_index: int
    images: StereoImages
    rig: StereoRig
    drogue: DrogueParameters | None
    record: PairRecord | None


class ShownPairs(NamedTuple):
    """The indices of a dataset's pairs, ascending, and how to read one."""

    frame_indices: tuple[int, ...]
    read: Callable[[int], ShownPair]


def open_pairs(dataset: Location) -> ShownPairs:
    """The pairs of a dataset, with or without truth.

    Raises:
        ValueError: no dataset there, or one that cannot be trusted.
    """
    if open_storage(dataset).exists(BLIND_FILE):
        blind = BlindDataset(dataset)

        def read_blind(index: int) -> ShownPair:
            pair = blind.pair(index)
            return ShownPair(index, pair.images, pair.rig, pair.drogue, None)

        return ShownPairs(blind.frame_indices, read_blind)
    source = Dataset(dataset)

    def read(index: int) -> ShownPair:
        record = source.record(index)
        drogue = source.drogue_sought(record)
        return ShownPair(index, source.images(index), record.frame.rig, drogue, record)

    return ShownPairs(source.frame_indices, read)
