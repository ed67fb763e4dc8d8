"""The datasets that a training learns from, checked before it starts, as one list of pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from nav.training.image_cache import CachedPair, ImageCache, open_cache
from nav.training.image_views import Boxes, Image
from nav.training.training_observer import Observer
from nav.training.training_settings import SizePx, size_text

EyeIndex = int
"""0 the left eye, 1 the right."""


@dataclass(frozen=True)
class DatasetStamp:
    """Which dataset it was."""

    name: str
    dataset_sha256: str
    manifest_sha256: str


@dataclass(frozen=True, eq=False)
class Corpus:
    """Pairs of all datasets, one after another.

    Attributes:
        datasets: which they are, in the order given.
        size_px: (height, width) of the images.
        caches: one for each dataset.
        places: (P, 2) the dataset and the pair in it of each pair.
    """

    datasets: tuple[DatasetStamp, ...]
    size_px: SizePx
    caches: tuple[ImageCache, ...]
    places: NDArray[np.int64]

    def split(self, name: SplitName) -> NDArray[np.int64]:
        """(n,) the pairs of a split."""
        return np.array([pair for pair in range(len(self.places)) if self.entry(pair).split == name], dtype=np.int64)

    def entry(self, pair: int) -> CachedPair:
        """What is known of a pair."""
        dataset, index = self.places[pair]
        entry: CachedPair = self.caches[dataset].pairs[index]
        return entry

    def image(self, pair: int, eye: EyeIndex) -> Image:
        """(H, W, 3) of one eye, not to be written to."""
        dataset, index = self.places[pair]
        image: Image = self.caches[dataset].images[index, eye]
        return image

    def boxes(self, pair: int, eye: EyeIndex) -> Boxes:
        """(n, 4) of one eye, n at most 1."""
        box = self.entry(pair).boxes[eye]
        return np.zeros((0, 4)) if box is None else np.array([box])


def open_corpus(
    paths: Sequence[Location],
    cache: Path,
    size_px: SizePx,
    threads: int,
    observer: Observer,
    should_stop: Callable[[], bool] = lambda: False,
) -> Corpus:
    """Open datasets to learn from; whatever could stop the training later is looked for here.

    Args:
        paths: folders or URLs of the datasets.
        cache: folder of their images at the size of the network's input.
        size_px: (height, width) of that.
        threads: that decode.
        observer: is told how far it is.
        should_stop: asked after every image.

    Raises:
        ValueError: no datasets, one twice, a missing, damaged or changed file, no drogue, images of different sizes, or
            no split to train on; names the path.
        OSError: the cache cannot be written.
        KeyboardInterrupt: it was told to stop.
    """
    datasets = _open_datasets(paths)
    caches = []
    for dataset in datasets:
        observer.begin(f"images of {dataset.path} at {size_text(size_px)}", len(dataset.frame_indices))
        try:
            caches.append(open_cache(dataset, cache, size_px, threads, observer, should_stop))
        finally:
            observer.end()
        if not any(box is not None for pair in caches[-1].pairs for box in pair.boxes):
            raise ValueError(f"{dataset.path}: shows no drogue in any image; there is nothing to learn from")
    stamps = tuple(
        DatasetStamp(dataset.manifest.name, dataset.manifest.dataset_sha256, dataset.manifest.manifest_sha256)
        for dataset in datasets
    )
    places = [(number, index) for number, cache_ in enumerate(caches) for index in range(len(cache_.pairs))]
    corpus = Corpus(stamps, size_px, tuple(caches), np.array(places, dtype=np.int64))
    if not any(len(corpus.boxes(pair, eye)) for pair in corpus.split("train") for eye in (0, 1)):
        raise ValueError(f"{paths[0]}: shows no drogue in any image of the split train; there is nothing to learn from")
    return corpus


def _open_datasets(paths: Sequence[Location]) -> list[Dataset]:
    """The datasets, after every check that needs no image."""
    if not paths:
        raise ValueError("datasets: none given; name a recipe or a dataset's folder")
    datasets = [Dataset(path) for path in paths]
    of_hash: dict[str, Location] = {}
    for dataset in datasets:
        manifest = dataset.manifest
        if manifest.dataset_sha256 in of_hash:
            raise ValueError(f"{dataset.path}: is the same dataset as {of_hash[manifest.dataset_sha256]}; name it once")
        of_hash[manifest.dataset_sha256] = dataset.path
        if all(entry.empty for entry in manifest.frames):
            raise ValueError(f"{dataset.path}: has no pair with a drogue; there is nothing to learn from")
        # Rigs may differ otherwise: a network sees pixels, and how large a drogue is in them, not focal lengths.
        first, camera = datasets[0].manifest.recipe.rig.camera, manifest.recipe.rig.camera
        if (camera.width_px, camera.height_px) != (first.width_px, first.height_px):
            raise ValueError(
                f"{dataset.path}: its images are {camera.width_px} x {camera.height_px} px, but those of {paths[0]} "
                f"{first.width_px} x {first.height_px} px; train on datasets of one image size"
            )
    if not any(entry.split == "train" for dataset in datasets for entry in dataset.manifest.frames):
        raise ValueError(f"{paths[0]}: has no pair in the split train; give the recipe `[split] train` above 0")
    return datasets
