"""A dataset's images at the size of the network's input, kept on disk once they were decoded and checked.

A cache is a folder that appears whole, by one rename, and is named by the dataset's hash and the size: `images.npy`, an
array that is mapped into memory, and `index.json`. Deleting it costs the time to make it again.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from datasets_manifest.atomic import PART_SUFFIX, new_folder
from datasets_manifest.storage.locking import takes_lock
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from drogue_models.frozen_model import FrozenModel
from geometry.stereo import EYES
from nav.detector.input_image import input_image
from nav.training.prefetch_map import in_order
from nav.training.training_observer import Observer
from nav.training.training_settings import SizePx, size_text

_VERSION = 1  # grows with every change of what stands in a cache
_IMAGES_FILE, _INDEX_FILE, _LOCK_FILE = "images.npy", "index.json", ".lock"
_ASK_AGAIN_S = 0.2


class CachedPair(FrozenModel):
    """What training knows of a stereo pair.

    Attributes:
        boxes: of the left and the right eye: the visible drogue on the cached image, x, y of the low corner, width,
            height, counted from the corner; None where none is visible. [px]
    """

    frame_index: int
    split: SplitName
    boxes: tuple[tuple[float, float, float, float] | None, tuple[float, float, float, float] | None]


class _Index(FrozenModel):
    version: int
    dataset_sha256: str
    size_px: SizePx
    pairs: tuple[CachedPair, ...]


@dataclass(frozen=True, eq=False)
class ImageCache:
    """The pairs of a dataset.

    Attributes:
        images: (P, 2, H, W, 3) left and right, gamma-encoded red, green, blue; mapped from disk.
        pairs: P entries.
    """

    images: NDArray[np.uint8]
    pairs: tuple[CachedPair, ...]


class _ReadPair(NamedTuple):
    images: list[NDArray[np.uint8]]
    entry: CachedPair


def open_cache(
    dataset: Dataset,
    folder: Path,
    size_px: SizePx,
    threads: int,
    observer: Observer,
    should_stop: Callable[[], bool],
) -> ImageCache:
    """The dataset's cache, made if it is not there: every image is decoded, and all hashes are checked.

    Args:
        dataset: whose images.
        folder: of all caches.
        size_px: (height, width) of the network's input.
        threads: that decode.
        observer: is told of each pair that is decoded, and if others at work on the caches are waited for.
        should_stop: asked after each pair, and while waiting.

    Raises:
        ValueError: a file of the dataset is missing, damaged or changed; names it.
        OSError: the cache cannot be written.
        KeyboardInterrupt: it was told to stop.
    """

    def advance() -> None:
        observer.advance()
        if should_stop():
            raise KeyboardInterrupt

    place = folder / f"{dataset.manifest.dataset_sha256[:20]}-{size_text(size_px)}"
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, observer, should_stop):
        cache = _read(place, dataset, size_px)
        if cache is None:
            shutil.rmtree(place, ignore_errors=True)
            for leftover in folder.glob(f".*{PART_SUFFIX}"):
                shutil.rmtree(leftover, ignore_errors=True)
            with new_folder(place) as part:
                _write(part, dataset, size_px, threads, advance)
            cache = _read(place, dataset, size_px)
    if cache is None:
        raise ValueError(f"{place}: cannot be read again after it was written; is the disk sound?")
    return cache


@contextmanager
def _locked(folder: Path, observer: Observer, should_stop: Callable[[], bool]) -> Iterator[None]:
    """Let others who want the same caches wait; the kernel frees the lock when the process ends, however it ends."""
    with (folder / _LOCK_FILE).open("a") as lock:
        said = False
        while not takes_lock(lock):
            if not said:
                observer.say(f"{folder}: waiting for another training that makes images there")
                said = True
            if should_stop():
                raise KeyboardInterrupt
            time.sleep(_ASK_AGAIN_S)
        yield


def _read(place: Path, dataset: Dataset, size_px: SizePx) -> ImageCache | None:
    """The cache, or None where it is missing, truncated or of other contents."""
    try:
        index = _Index.model_validate_json((place / _INDEX_FILE).read_bytes())
        images = np.load(place / _IMAGES_FILE, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    wanted = (_VERSION, dataset.manifest.dataset_sha256, size_px)
    is_whole = images.shape == (len(index.pairs), 2, *size_px, 3) and images.dtype == np.uint8
    is_wanted = (index.version, index.dataset_sha256, index.size_px) == wanted
    return ImageCache(images, index.pairs) if is_whole and is_wanted else None


def _write(part: Path, dataset: Dataset, size_px: SizePx, threads: int, advance: Callable[[], None]) -> None:
    splits = dataset.manifest.split_of_frame()

    def read(frame_index: int) -> _ReadPair:
        return _read_pair(dataset, frame_index, splits[frame_index], size_px)

    pairs: list[CachedPair] = []
    with (part / _IMAGES_FILE).open("wb") as stream:
        _write_header(stream, (len(dataset.frame_indices), 2, *size_px, 3))
        for pair in in_order(read, dataset.frame_indices, threads, 2 * threads):
            # Written, not mapped: a full disk is an error here, and would end the process there.
            for image in pair.images:
                stream.write(np.ascontiguousarray(image).data)
            pairs.append(pair.entry)
            advance()
        stream.flush()
        os.fsync(stream.fileno())
    index = _Index(
        version=_VERSION, dataset_sha256=dataset.manifest.dataset_sha256, size_px=size_px, pairs=tuple(pairs)
    )
    (part / _INDEX_FILE).write_text(json.dumps(index.model_dump(mode="json")), encoding="utf-8")


def _write_header(stream: BinaryIO, shape: tuple[int, ...]) -> None:
    header: dict[str, Any] = {"descr": "|u1", "fortran_order": False, "shape": shape}
    npy.write_array_header_2_0(stream, header)  # type: ignore[no-untyped-call]


def _read_pair(dataset: Dataset, frame_index: int, split: SplitName, size_px: SizePx) -> _ReadPair:
    faults = dataset.verify(frame_index)
    if faults:
        raise ValueError(faults[0])
    record, stereo = dataset.record(frame_index), dataset.images(frame_index)
    images, boxes = [], []
    for eye in EYES:
        image, place = input_image(stereo, eye, (size_px[1], size_px[0]))
        images.append(image)
        box = getattr(record.views, eye).box_visible_xywh_px
        boxes.append(None if box is None else tuple(place.to_input(box)[0].tolist()))
    return _ReadPair(images, CachedPair(frame_index=frame_index, split=split, boxes=(boxes[0], boxes[1])))
