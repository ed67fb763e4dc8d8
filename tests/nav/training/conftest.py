"""Small datasets of the analytic engine, and a corpus of plain ellipses made in memory."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.pair_faults import PairFaults
from nav.training.corpus import CachedPair, Corpus, ImageCache
from tests.support.shared_folder import shared_folder
from tests.support.small_datasets import render_toy


@pytest.fixture(scope="session")
def toy_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """40 pairs, all to train on; to be read only."""
    return shared_folder(tmp_path_factory, "toy", render_toy)


@pytest.fixture(scope="session")
def split_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight pairs of four scenes in all three splits; to be read only (copy it to change it)."""
    frames, split = {"count": 8, "scenes": 4, "empty_fraction": None}, {"train": 0.5, "val": 0.25, "test": 0.25}
    return shared_folder(tmp_path_factory, "split", lambda out: render_toy(out, frames=frames, split=split))


def paint_ellipse(image: np.ndarray, box: tuple[float, float, float, float], color: int = 255) -> None:
    """The ellipse in a box, by OpenCV; coordinates from the corner of the image."""
    x, y, width, height = box
    center, size = (x + width / 2 - 0.5, y + height / 2 - 0.5), (width, height)
    cv2.ellipse(image, (center, size, 0.0), (color,) * 3, -1)


@pytest.fixture(scope="session")
def ellipse_corpus() -> Corpus:
    """12 pairs of white ellipses on black, 96 x 128; both eyes see the same; each has a grey level of its own."""
    rng = np.random.default_rng(3)
    images, pairs = np.zeros((12, 2, 96, 128, 3), np.uint8), []
    for number in range(12):
        x, y, width, height = *rng.uniform(5, 50, 2), *rng.uniform(16, 40, 2)
        for eye in (0, 1):
            images[number, eye] = number
            paint_ellipse(images[number, eye], (x, y, width, height))
        box = (float(x), float(y), float(width), float(height))
        pairs.append(CachedPair(frame_index=number, split="train", boxes=(box, box)))
    places = np.array([(0, index) for index in range(12)])
    return Corpus((), (96, 128), (ImageCache(images, tuple(pairs), PairFaults(), np.zeros(0, np.uint8)),), places)
