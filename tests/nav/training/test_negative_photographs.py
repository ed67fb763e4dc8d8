"""Photographs without a drogue beside the pairs of a training."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from droguekit.batch.progress import PlainProgress
from nav.training.augmentation import ImageView
from nav.training.corpus import Corpus, open_corpus
from nav.training.negative_photographs import Photographs, read_photographs
from nav.training.trainer import BatchMaker
from nav.training.training_settings import build_settings

SIZE = (64, 96)
Member = tuple[int, int]


def save(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def test_a_photograph_fills_the_input_and_a_large_one_is_also_taken_in_quarters(tmp_path: Path) -> None:
    wide = np.zeros((70, 300, 3), np.uint8)
    wide[:, 100:200] = 255
    save(tmp_path / "a" / "wide.png", wide)
    large = np.zeros((200, 200), np.uint16)
    large[:100, 100:] = 60000
    save(tmp_path / "large.png", large)
    found = read_photographs(tmp_path, SIZE)
    assert found.images.shape == (6, *SIZE, 3) and found.images.dtype == np.uint8
    # Only its middle is left of the wide one, of which the sides are black.
    assert (found.images[0][:, 4:-4] == 255).mean() > 0.9
    # The others: the square one, as large as it fills 96 px of width, and its quarters.
    assert [round(float(cut.mean()), -1) for cut in found.images[2:]] == [0, 260, 0, 0]
    assert read_photographs(tmp_path, SIZE).sha256 == found.sha256
    assert read_photographs(tmp_path, (64, 64)).sha256 != found.sha256


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"not a picture")
    with pytest.raises(ValueError, match=r"broken\.jpg: is truncated"):
        read_photographs(tmp_path, SIZE)
    with pytest.raises(ValueError, match="is no folder of pictures"):
        read_photographs(tmp_path / "none", SIZE)


@pytest.fixture
def with_photographs(ellipse_corpus: Corpus) -> Corpus:
    """The plain corpus with three photographs, grey 200, 201 and 202; nothing in the others is between 20 and 250."""
    images = np.stack([np.full((96, 128, 3), 200 + number, np.uint8) for number in range(3)])
    return replace(ellipse_corpus, without_drogue=Photographs(images, "0" * 64))


def members_of(corpus: Corpus, fraction: float, mosaic: bool) -> list[list[list[Member]]]:
    """The members of some samples, by tile and eye."""
    shown: list[list[list[Member]]] = []

    class Watched(BatchMaker):
        def _sample_views(
            self, rng: np.random.Generator, members: list[list[Member]], size: tuple[int, int], is_mosaic: bool
        ) -> list[ImageView]:
            shown.append(members)
            return super()._sample_views(rng, members, size, is_mosaic)

    changes = {"size_px": (96, 128), "batch_images": 8, "image_passes": 800, "photograph_fraction": fraction}
    maker = Watched(corpus, build_settings(None, {**changes, "mosaic": mosaic, "mosaic_fraction": 1.0}))
    for step in range(40):
        maker.batch(step)
    return shown


def test_photographs_take_places_beside_the_image_whose_turn_it_is(with_photographs: Corpus) -> None:
    assert with_photographs.photographs.tolist() == [12, 13, 14]
    samples = members_of(with_photographs, 0.3, mosaic=True)
    assert all(sum(tile[0][0] < 12 for tile in sample) >= 1 for sample in samples)
    drawn = [tile[0][0] >= 12 for sample in samples for tile in sample]
    # 160 mosaics with three places each; the standard deviation is 0.02.
    assert np.mean(drawn) == pytest.approx(0.3 * 3 / 4, abs=0.06)
    # Both eyes see the same photograph.
    assert all(tile[0][0] == tile[1][0] for sample in samples for tile in sample)


def test_images_alone_are_replaced_too(with_photographs: Corpus) -> None:
    samples = members_of(with_photographs, 0.3, mosaic=False)
    assert np.mean([sample[0][0][0] >= 12 for sample in samples]) == pytest.approx(0.3, abs=0.12)


def test_a_photograph_has_no_boxes_and_its_own_pixels(with_photographs: Corpus) -> None:
    assert with_photographs.boxes(13, 1).shape == (0, 4)
    assert (with_photographs.image(13, 0) == 201).all()


def test_the_fraction_0_shows_the_same_images_as_without_any(with_photographs: Corpus, ellipse_corpus: Corpus) -> None:
    assert members_of(with_photographs, 0.0, mosaic=True) == members_of(ellipse_corpus, 0.2, mosaic=True)


def test_other_photographs_are_another_corpus(toy_dataset: Path, tmp_path: Path) -> None:
    stamps = []
    for grey in (90, 91):
        save(tmp_path / "photographs" / "grey.png", np.full((80, 80, 3), grey, np.uint8))
        corpus = open_corpus(
            [toy_dataset],
            tmp_path / "cache",
            SIZE,
            1,
            PlainProgress(io.StringIO()),
            photographs=tmp_path / "photographs",
        )
        stamps.append(corpus.datasets)
    assert stamps[0][0] == stamps[1][0] and stamps[0][1] != stamps[1][1]
