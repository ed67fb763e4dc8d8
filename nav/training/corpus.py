"""The datasets of a training, checked before it starts, as one list of pairs with a cache of decoded images.

An image cache is a folder that holds one dataset's images at the size of the network's input. It appears whole, by one
rename, and its name has the dataset's hash and the size. It holds `images.npy`, an array that is mapped into memory,
`opacities.npy`, of the drogues that can be cut out of them, and `index.json`. If it is deleted, the next training makes
it again.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from datasets_manifest.atomic import PART_SUFFIX, new_folder, try_lock
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PixelBox, ViewRecord
from drogue_models.frozen_model import FrozenModel
from geometry.stereo import EYES
from nav.detector.input_image import Letterbox, input_image
from nav.training.augmentation import Boxes, Image
from nav.training.drogue_cutouts import Alpha, Cutout, cut_out
from nav.training.negative_photographs import Photographs, read_photographs
from nav.training.prefetch_map import prefetch_map
from nav.training.training_progress import TrainingObserver
from nav.training.training_settings import SizePx, size_text

EyeIndex = int
"""0 the left eye, 1 the right."""
_VERSION = 4  # incremented with every change of a cache's contents
_IMAGES_FILE, _OPACITIES_FILE, _INDEX_FILE, _LOCK_FILE = "images.npy", "opacities.npy", "index.json", ".lock"
_LOCK_POLL_S = 0.2
_PHOTOGRAPHS = "photographs"


class CachedPair(FrozenModel):
    """The labels of a cached stereo pair.

    Attributes:
        frame_index: in its dataset.
        split: that it belongs to.
        boxes: of the left and the right eye: the visible part of the drogue in the cached image, x, y of the low
            corner, width, height, counted from the image's corner; None where none is visible. [px]
        others: of both eyes, those of the drogues beside it. [px]
        cutouts: of both eyes, where the drogue can be cut out, or None where it is not wholly seen.
    """

    frame_index: int
    split: SplitName
    boxes: tuple[tuple[float, float, float, float] | None, tuple[float, float, float, float] | None]
    others: tuple[tuple[tuple[float, float, float, float], ...], tuple[tuple[float, float, float, float], ...]] = (
        (),
        (),
    )
    cutouts: tuple[Cutout | None, Cutout | None] = (None, None)


class _Index(FrozenModel):
    version: int
    dataset_sha256: str
    size_px: SizePx
    pairs: tuple[CachedPair, ...]
    damaged: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class ImageCache:
    """The images and labels of a dataset's pairs.

    Attributes:
        images: (P, 2, H, W, 3) left and right, gamma-encoded red, green, blue; memory-mapped.
        pairs: the labels of P pairs.
        faults: of the other pairs, which are damaged, and of pairs that can no longer be read as they were taken.
        opacities: (n,) of all cut-outs, one after the other, row by row, 0 to 255; memory-mapped.
    """

    images: NDArray[np.uint8]
    pairs: tuple[CachedPair, ...]
    faults: PairFaults
    opacities: NDArray[np.uint8]


class _ReadPair(NamedTuple):
    images: list[NDArray[np.uint8]]
    cutouts: list[tuple[Cutout, Alpha] | None]
    entry: CachedPair


class _DamagedPair(NamedTuple):
    frame_index: int
    fault: str


def open_image_cache(
    dataset: Dataset,
    folder: Path,
    size_px: SizePx,
    threads: int,
    observer: TrainingObserver,
    should_stop: Callable[[], bool],
) -> ImageCache:
    """Open a dataset's cache; if there is none, make it: decode every image, and check all hashes.

    Damaged pairs are left out. Once one of them is whole again, the cache is made again.

    Args:
        dataset: with the images.
        folder: of all caches.
        size_px: (height, width) of the network's input.
        threads: number of decoding threads.
        observer: is informed of each decoded pair, and when another process that makes caches is waited for.
        should_stop: called after each pair, and while waiting.

    Raises:
        ValueError: all pairs of the dataset are damaged; the message names a file.
        OSError: the cache cannot be written.
        KeyboardInterrupt: `should_stop` returned true.
    """

    def advance() -> None:
        observer.advance()
        if should_stop():
            raise KeyboardInterrupt

    cache_folder = folder / f"{dataset.manifest.dataset_sha256[:20]}-{size_text(size_px)}"
    folder.mkdir(parents=True, exist_ok=True)
    with _locked(folder, observer, should_stop):
        cache = _read(cache_folder, dataset, size_px)
        if cache is None:
            shutil.rmtree(cache_folder, ignore_errors=True)
            for leftover in folder.glob(f".*{PART_SUFFIX}"):
                shutil.rmtree(leftover, ignore_errors=True)
            with new_folder(cache_folder) as part:
                _write(part, dataset, size_px, threads, advance)
            cache = _read(cache_folder, dataset, size_px)
    if cache is None:
        raise ValueError(f"{cache_folder}: cannot be read back after it was written; check the disk")
    return cache


@contextmanager
def _locked(folder: Path, observer: TrainingObserver, should_stop: Callable[[], bool]) -> Iterator[None]:
    """Hold the lock of a folder of caches; the kernel releases it when the process ends, however it ends."""
    with (folder / _LOCK_FILE).open("a") as lock:
        is_reported = False
        while not try_lock(lock):
            if not is_reported:
                observer.say(f"{folder}: waiting for another training that caches images there")
                is_reported = True
            if should_stop():
                raise KeyboardInterrupt
            time.sleep(_LOCK_POLL_S)
        yield


def _read(cache_folder: Path, dataset: Dataset, size_px: SizePx) -> ImageCache | None:
    """The cache; None where it is missing, truncated or of other contents."""
    try:
        index = _Index.model_validate_json((cache_folder / _INDEX_FILE).read_bytes())
        images = np.load(cache_folder / _IMAGES_FILE, mmap_mode="r", allow_pickle=False)
        opacities = np.load(cache_folder / _OPACITIES_FILE, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return None
    wanted = (_VERSION, dataset.manifest.dataset_sha256, size_px)
    ends = [cut.offset + cut.width * cut.height for pair in index.pairs for cut in pair.cutouts if cut is not None]
    is_whole = images.shape == (len(index.pairs), 2, *size_px, 3) and opacities.shape == (max(ends, default=0),)
    is_whole &= images.dtype == opacities.dtype == np.uint8
    is_wanted = (index.version, index.dataset_sha256, index.size_px) == wanted
    if not (is_whole and is_wanted):
        return None
    faults = PairFaults()
    for frame_index in index.damaged:
        found = dataset.verify(frame_index)
        if not found:
            return None
        faults.note(frame_index, found[0])
    return ImageCache(images, index.pairs, faults, opacities)


def _write(part: Path, dataset: Dataset, size_px: SizePx, threads: int, advance: Callable[[], None]) -> None:
    splits = dataset.manifest.split_of_frame()

    def read(frame_index: int) -> _ReadPair | _DamagedPair:
        faults = dataset.verify(frame_index)
        if faults:
            return _DamagedPair(frame_index, faults[0])
        return _read_pair(dataset, frame_index, splits[frame_index], size_px)

    pairs: list[CachedPair] = []
    damaged: list[_DamagedPair] = []
    with _ArrayFile(part / _IMAGES_FILE, (2, *size_px, 3)) as images, _ArrayFile(part / _OPACITIES_FILE, ()) as alphas:
        for pair in prefetch_map(read, dataset.frame_indices, threads, 2 * threads):
            if isinstance(pair, _DamagedPair):
                damaged.append(pair)
                advance()
                continue
            images.append(np.stack(pair.images)[None])
            offsets = [alphas.append(np.zeros(0, np.uint8) if cut is None else cut[1].ravel()) for cut in pair.cutouts]
            left, right = (
                None if cut is None else cut[0].model_copy(update={"offset": offset})
                for cut, offset in zip(pair.cutouts, offsets, strict=True)
            )
            pairs.append(pair.entry.model_copy(update={"cutouts": (left, right)}))
            advance()
        if not pairs:
            raise ValueError(damaged[0].fault)
    index = _Index(
        version=_VERSION,
        dataset_sha256=dataset.manifest.dataset_sha256,
        size_px=size_px,
        pairs=tuple(pairs),
        damaged=tuple(each.frame_index for each in damaged),
    )
    (part / _INDEX_FILE).write_text(json.dumps(index.model_dump(mode="json")), encoding="utf-8")


class _ArrayFile:
    """An array in numpy's format that grows along its first axis.

    Written, not memory-mapped: a full disk raises an error here, but would kill the process there.
    """

    def __init__(self, path: Path, item_shape: tuple[int, ...]) -> None:
        self._stream, self._item_shape, self._length = path.open("wb"), item_shape, 0

    def __enter__(self) -> Self:
        self._write_header()
        return self

    def append(self, items: NDArray[np.uint8]) -> int:
        """Write items behind the others; the index of the first."""
        self._stream.write(np.ascontiguousarray(items).data)
        self._length += len(items)
        return self._length - len(items)

    def __exit__(self, *_: object) -> None:
        # The header has room for any length, and so it stays as long as it is.
        with self._stream:
            self._stream.seek(0)
            self._write_header()
            self._stream.flush()
            os.fsync(self._stream.fileno())

    def _write_header(self) -> None:
        header = {"descr": "|u1", "fortran_order": False, "shape": (self._length, *self._item_shape)}
        npy.write_array_header_2_0(self._stream, header)  # type: ignore[no-untyped-call]


def _read_pair(dataset: Dataset, frame_index: int, split: SplitName, size_px: SizePx) -> _ReadPair:
    record, stereo = dataset.unchanged_record(frame_index), dataset.images(frame_index)
    images, cutouts, boxes, others = [], [], [], []
    input_wh = (size_px[1], size_px[0])
    for eye in EYES:
        image, placement = input_image(stereo, eye, input_wh)
        images.append(image)
        view: ViewRecord = getattr(record.views, eye)
        cutouts.append(cut_out(dataset.part_ids(frame_index, eye), view, placement, input_wh))
        box = view.box_visible_xywh_px
        boxes.append(None if box is None else _in_input(placement, box))
        beside = [other.box_visible_xywh_px for other in view.neighbours]
        others.append(tuple(_in_input(placement, box) for box in beside if box is not None))
    entry = CachedPair(frame_index=frame_index, split=split, boxes=(boxes[0], boxes[1]), others=(others[0], others[1]))
    return _ReadPair(images, cutouts, entry)


def _in_input(placement: Letterbox, box: PixelBox) -> PixelBox:
    x, y, width, height = placement.to_input(np.array(box))[0].tolist()
    return x, y, width, height


@dataclass(frozen=True)
class DatasetStamp:
    """What identifies a dataset, and how many of its pairs a network is trained on.

    A training can be resumed where other pairs were damaged meanwhile. Photographs have no manifest, and an empty hash
    of it.
    """

    name: str
    dataset_sha256: str
    manifest_sha256: str
    train_pairs: int


@dataclass(frozen=True, eq=False)
class Corpus:
    """The pairs of all datasets, in one sequence, and behind them photographs without a drogue.

    Attributes:
        datasets: in the order given, and the photographs.
        size_px: (height, width) of the images.
        caches: one for each dataset.
        places: (P, 2) for each pair the index of its dataset, and its index in that dataset.
        without_drogue: photographs to train on beside the pairs, the same for both eyes, or None.
        sources: the datasets themselves, for images as they were taken and for faults; may be left out.
    """

    datasets: tuple[DatasetStamp, ...]
    size_px: SizePx
    caches: tuple[ImageCache, ...]
    places: NDArray[np.int64]
    without_drogue: Photographs | None = None
    sources: tuple[Dataset, ...] = ()

    @property
    def fault(self) -> str | None:
        """Damaged pairs so far, which are left out, as one line; None for nothing."""
        lines = ((source.path, cache.faults.line()) for source, cache in zip(self.sources, self.caches, strict=False))
        return next((f"{path}: {line}" for path, line in lines if line is not None), None)

    @property
    def photographs(self) -> NDArray[np.int64]:
        """(n,) indices of the photographs, as if they were pairs."""
        count = 0 if self.without_drogue is None else len(self.without_drogue.images)
        return np.arange(len(self.places), len(self.places) + count)

    @cached_property
    def pairs_to_cut(self) -> NDArray[np.int64]:
        """(n,) indices of the pairs of the split `train` whose drogue can be cut out of both images."""
        return np.array([pair for pair in self.split("train") if None not in self.entry(pair).cutouts], dtype=np.int64)

    def split(self, name: SplitName) -> NDArray[np.int64]:
        """(n,) indices of the pairs of a split."""
        return np.array([pair for pair in range(len(self.places)) if self.entry(pair).split == name], dtype=np.int64)

    def entry(self, pair: int) -> CachedPair:
        """The labels of a pair."""
        dataset, index = self.places[pair]
        entry: CachedPair = self.caches[dataset].pairs[index]
        return entry

    def image(self, pair: int, eye: EyeIndex) -> Image:
        """(H, W, 3) image of one eye, read-only."""
        if self.without_drogue is not None and pair >= len(self.places):
            photograph: Image = self.without_drogue.images[pair - len(self.places)]
            return photograph
        dataset, index = self.places[pair]
        image: Image = self.caches[dataset].images[index, eye]
        return image

    def stereo_images(self, pair: int) -> StereoImages | None:
        """Both images of a pair as they were taken, from its dataset; None, and a fault, if they are damaged by now."""
        dataset, _ = self.places[pair]
        source: Dataset = self.sources[dataset]
        cache: ImageCache = self.caches[dataset]
        return read_or_note(self.entry(pair).frame_index, source.images, cache.faults)

    def opacity(self, pair: int, eye: EyeIndex) -> tuple[Cutout, Alpha]:
        """Where the drogue of one eye is cut out, and its (h, w) opacities, 0 to 255; only of `pairs_to_cut`."""
        dataset, index = self.places[pair]
        cutout = self.caches[dataset].pairs[index].cutouts[eye]
        if cutout is None:
            raise ValueError(f"pair {pair}: its drogue cannot be cut out")
        end = cutout.offset + cutout.width * cutout.height
        return cutout, self.caches[dataset].opacities[cutout.offset : end].reshape(cutout.height, cutout.width)

    def boxes(self, pair: int, eye: EyeIndex) -> Boxes:
        """(n, 4) boxes of one eye: that of the sought drogue if it is seen, then those of drogues beside it."""
        if pair >= len(self.places):
            return np.zeros((0, 4))
        entry = self.entry(pair)
        found = [*([] if entry.boxes[eye] is None else [entry.boxes[eye]]), *entry.others[eye]]
        return np.array(found, dtype=np.float64).reshape(-1, 4)


def open_corpus(
    paths: Sequence[Location],
    cache: Path,
    size_px: SizePx,
    threads: int,
    observer: TrainingObserver,
    should_stop: Callable[[], bool] = lambda: False,
    photographs: Path | None = None,
) -> Corpus:
    """Open the datasets of a training, and check everything in them that could stop it later.

    Args:
        paths: folders or URLs of the datasets.
        cache: folder of the image caches.
        size_px: (height, width) of the network's input.
        threads: number of decoding threads.
        observer: is informed of the progress.
        should_stop: called after every pair.
        photographs: folder of pictures without a drogue, or None.

    Raises:
        ValueError: no datasets, one twice, one without a whole pair, none with a drogue, images of different sizes,
            or no split to train on, or a photograph that cannot be read; the message names the path.
        OSError: the cache cannot be written.
        KeyboardInterrupt: `should_stop` returned true.
    """
    datasets = _open_datasets(paths)
    without = None if photographs is None else read_photographs(photographs, size_px)
    caches: list[ImageCache] = []
    for dataset in datasets:
        observer.begin(f"images of {dataset.path} at {size_text(size_px)}", len(dataset.frame_indices))
        try:
            caches.append(open_image_cache(dataset, cache, size_px, threads, observer, should_stop))
        finally:
            observer.end()
        if (line := caches[-1].faults.line()) is not None:
            observer.say(f"{dataset.path}: {line}")
        has_boxes = any(box is not None for pair in caches[-1].pairs for box in pair.boxes)
        if not has_boxes and not _is_without_drogue(dataset):
            raise ValueError(f"{dataset.path}: shows no drogue in any image; there is nothing to learn from")
    stamps = tuple(
        DatasetStamp(
            manifest.name,
            manifest.dataset_sha256,
            manifest.manifest_sha256,
            sum(pair.split == "train" for pair in images.pairs),
        )
        for manifest, images in zip((dataset.manifest for dataset in datasets), caches, strict=True)
    )
    if without is not None:
        stamps += (DatasetStamp(_PHOTOGRAPHS, without.sha256, "", len(without.images)),)
    places = [(number, index) for number, cache_ in enumerate(caches) for index in range(len(cache_.pairs))]
    corpus = Corpus(stamps, size_px, tuple(caches), np.array(places, dtype=np.int64), without, tuple(datasets))
    if not any(len(corpus.boxes(pair, eye)) for pair in corpus.split("train") for eye in (0, 1)):
        raise ValueError(f"{paths[0]}: shows no drogue in any image of the split train; there is nothing to learn from")
    return corpus


def _open_datasets(paths: Sequence[Location]) -> list[Dataset]:
    """Open the datasets, with all checks that need no image."""
    if not paths:
        raise ValueError("datasets: none given; name a recipe or a dataset's folder")
    datasets = [Dataset(path) for path in paths]
    of_hash: dict[str, Location] = {}
    for dataset in datasets:
        manifest = dataset.manifest
        if manifest.dataset_sha256 in of_hash:
            raise ValueError(f"{dataset.path}: is the same dataset as {of_hash[manifest.dataset_sha256]}; name it once")
        of_hash[manifest.dataset_sha256] = dataset.path
        # Focal lengths may differ: a network sees only how large a drogue is in pixels.
        first, camera = datasets[0].manifest.recipe.rig.camera, manifest.recipe.rig.camera
        if (camera.width_px, camera.height_px) != (first.width_px, first.height_px):
            raise ValueError(
                f"{dataset.path}: its images are {camera.width_px} x {camera.height_px} px, but those of {paths[0]} "
                f"{first.width_px} x {first.height_px} px; train on datasets of one image size"
            )
    if not any(entry.split == "train" for dataset in datasets for entry in dataset.manifest.frames):
        raise ValueError(f"{paths[0]}: has no pair in the split train; give the recipe `[split] train` above 0")
    if all(_is_without_drogue(dataset) for dataset in datasets):
        raise ValueError(f"{datasets[0].path}: has no pair with a drogue; there is nothing to learn from")
    return datasets


def _is_without_drogue(dataset: Dataset) -> bool:
    """Whether no frame shows a drogue: such a dataset shows what is none, beside others that have some."""
    return all(entry.empty for entry in dataset.manifest.frames)
