"""The corpus as peers get it: the pictures that our own networks see, and boxes with the drogue as the only class."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.image_codecs import encode_png
from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PixelBox
from geometry.stereo import EYES
from nav.detector.input_image import Letterbox, input_image

SPLITS: tuple[SplitName, ...] = ("train", "val", "test")


def check_corpus(corpus: Path, test: Path) -> None:
    """Check that datasets have the pairs to train, validate and score with, and share no scenes.

    Args:
        corpus: needs pairs to train on and to validate with.
        test: needs pairs to score; may be the corpus.

    Raises:
        ValueError: a dataset cannot be read or lacks a split, or both have the same seed and so the same scenes.
    """
    needed: dict[Path, tuple[SplitName, ...]] = {corpus: ("train", "val")}
    needed[test] = (*needed.get(test, ()), "test")
    manifests = {dataset: Dataset(dataset).manifest for dataset in needed}
    for dataset, splits in needed.items():
        counts = manifests[dataset].counts.by_split
        if not all(counts.get(split) for split in splits):
            raise ValueError(f"{dataset}: needs pairs in the splits {', '.join(splits)}, got {dict(counts)}")
    seeds = {manifest.recipe.seed for manifest in manifests.values()}
    if len(seeds) < len(needed):
        raise ValueError(
            f"{test}: has scenes of {corpus}, for both have the seed {min(seeds)}; render one with another seed, "
            "or leave --test away to score the corpus's own split"
        )


def export_corpus(corpus: Path, out: Path, size_px: tuple[int, int]) -> Path:
    """Write images and boxes, unless they exist already.

    Args:
        corpus: a dataset.
        out: folder.
        size_px: width and height of the images. They are made like our networks' input, because other projects
            would resize them in another way.

    Returns:
        The file `data.yaml`.

    Raises:
        ValueError: the corpus cannot be read.
        OSError: the folder cannot be written; no partial folder is left.
    """
    data = out / "data.yaml"
    if data.exists():
        return data
    source = Dataset(corpus)
    splits = source.manifest.split_of_frame()
    with new_folder(out) as folder:
        for split in SPLITS:
            for kind in ("images", "labels"):
                (folder / kind / split).mkdir(parents=True)
        for index in source.frame_indices:
            record, images = source.record(index), source.images(index)
            for eye in EYES:
                image, placement = input_image(images, eye, size_px)
                name = f"{splits[index]}/{index:06d}_{eye}"
                (folder / "images" / f"{name}.png").write_bytes(encode_png(image))
                view = record.views.left if eye == "left" else record.views.right
                # Drogues of other tankers are boxes for us too, in training and in the scores.
                boxes = [view.box_visible_xywh_px, *(other.box_visible_xywh_px for other in view.neighbours)]
                rows = "".join(_row(box, placement, size_px) for box in boxes if box is not None)
                (folder / "labels" / f"{name}.txt").write_text(rows, encoding="utf-8")
        lines = "".join(f"{split}: images/{split}\n" for split in SPLITS)
        (folder / "data.yaml").write_text(f'path: ""\n{lines}names:\n  0: drogue\n', encoding="utf-8")
    return data


def training_image_count(corpus: Path) -> int:
    """Number of images of an epoch: both eyes of every pair of the split `train`.

    Raises:
        ValueError: the corpus cannot be read.
    """
    return 2 * Dataset(corpus).manifest.counts.by_split.get("train", 0)


def _row(box_px: PixelBox, placement: Letterbox, size_px: tuple[int, int]) -> str:
    """Class, centre and size of an image's box, as fractions of the image's size."""
    x, y, width, height = placement.to_input(np.array([box_px]))[0].tolist()
    fractions = [(x + width / 2) / size_px[0], (y + height / 2) / size_px[1], width / size_px[0], height / size_px[1]]
    return f"0 {' '.join(map(repr, fractions))}\n"


class TrainingLength(NamedTuple):
    """The length of a peer's training.

    Attributes:
        epochs: number of epochs.
        fraction: of the images, in each epoch.
        image_passes: number of image passes that result.
    """

    epochs: int
    fraction: float
    image_passes: int


def training_length(image_passes: int, images: int) -> TrainingLength:
    """The length whose number of image passes is nearest to the given one.

    Peers train whole epochs, and a fraction of the images would be the same images in every epoch. So passes are
    rounded to whole epochs of all images; only a training of less than one epoch leaves images out.

    Raises:
        ValueError: no images.
    """
    if images < 1:
        raise ValueError("corpus: has no images to train on")
    epochs, fraction = max(1, round(image_passes / images)), min(1.0, image_passes / images)
    return TrainingLength(epochs, fraction, epochs * round(fraction * images))
