"""Drogues that are cut out of pairs and pasted onto photographs: boxes against pixels."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from drogue_models.parts import MAX_MARKERS, Part, drogue_part_ids
from droguekit.batch.progress import PlainProgress
from nav.detector.input_image import letterbox
from nav.training.corpus import Corpus, open_corpus
from nav.training.drogue_cutouts import (
    Cutout,
    Look,
    Paste,
    _repaint,
    cut_out,
    is_clear,
    paste_drogue,
    pasted_box,
    pasted_rectangle,
    sample_paste,
)
from nav.training.negative_photographs import Photographs
from nav.training.trainer import BatchMaker
from nav.training.training_settings import build_settings

SIZE = (192, 256)


@pytest.fixture(scope="module")
def toy_corpus(toy_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Corpus:
    cache = tmp_path_factory.mktemp("cache")
    return open_corpus([toy_dataset], cache, SIZE, 1, PlainProgress(io.StringIO()))


def test_opacities_are_those_of_drogue_and_hose(toy_corpus: Corpus, toy_dataset: Path) -> None:
    dataset = Dataset(toy_dataset)
    assert 10 <= len(toy_corpus.pairs_to_cut) < len(toy_corpus.places)
    for pair in toy_corpus.pairs_to_cut:
        for eye, name in ((0, "left"), (1, "right")):
            cutout, alpha = toy_corpus.opacity(int(pair), eye)
            ids = dataset.part_ids(toy_corpus.entry(int(pair)).frame_index, name)
            shown = np.isin(ids, [*drogue_part_ids(MAX_MARKERS), Part.HOSE]).astype(np.uint8)
            small = cv2.resize(255 * shown, SIZE[::-1], interpolation=cv2.INTER_AREA)
            rows, columns = slice(cutout.y, cutout.y + cutout.height), slice(cutout.x, cutout.x + cutout.width)
            np.testing.assert_array_equal(alpha, small[rows, columns])
            x, y, width, height = toy_corpus.boxes(int(pair), eye)[0]
            assert cutout.x <= x and x + width <= cutout.x + cutout.width
            assert cutout.y <= y and y + height <= cutout.y + cutout.height


def test_drogues_that_are_cut_off_or_hidden_stay_where_they_are(toy_corpus: Corpus, toy_dataset: Path) -> None:
    dataset, cut = Dataset(toy_dataset), set(toy_corpus.pairs_to_cut.tolist())
    for pair in range(len(toy_corpus.places)):
        views = dataset.record(toy_corpus.entry(pair).frame_index).views
        if views.left.truncated or views.right.truncated or views.left.box_visible_xywh_px is None:
            assert pair not in cut


def test_a_drogue_with_something_before_its_middle_stays_where_it_is(toy_corpus: Corpus, toy_dataset: Path) -> None:
    dataset, pair = Dataset(toy_dataset), int(toy_corpus.pairs_to_cut[0])
    frame_index = toy_corpus.entry(pair).frame_index
    view, ids = dataset.record(frame_index).views.left, dataset.part_ids(frame_index, "left").copy()
    placement = letterbox(ids.shape[::-1], SIZE[::-1])
    assert cut_out(ids, view, placement, SIZE[::-1]) is not None
    x, y, width, height = view.box_visible_xywh_px
    ids[int(y + height / 2), int(x + width / 2)] = Part.PROBE
    assert cut_out(ids, view, placement, SIZE[::-1]) is None


@pytest.mark.parametrize(("scale", "center"), [(1.0, (60.3, 40.8)), (0.41, (100.0, 20.5)), (1.5, (64.0, 50.0))])
def test_a_pasted_drogue_lies_in_its_box(scale: float, center: tuple[float, float]) -> None:
    image = np.zeros((96, 128, 3), np.uint8)
    box = np.array([30.0, 21.0, 41.0, 27.0])
    cv2.ellipse(image, ((50.0, 34.0), (41.0, 27.0), 0.0), (250, 200, 150), -1)
    cutout = Cutout(x=20, y=10, width=70, height=50, offset=0)
    alpha = np.ascontiguousarray(np.where(image[10:60, 20:90, 0] > 0, 255, 0).astype(np.uint8))
    paste = Paste(0, scale, center, Look(gain=0.8))
    photograph = np.full((96, 128, 3), 10, np.uint8)
    shown = paste_drogue(photograph, image, box, cutout, alpha, paste)
    assert (photograph == 10).all()
    covered = shown[..., 0] > 60
    rows, columns = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    seen = [columns[0], rows[0], columns[-1] + 1 - columns[0], rows[-1] + 1 - rows[0]]
    # OpenCV's ellipse and half the contrast are off by up to half a pixel on either side, which is enlarged 1.5 times.
    np.testing.assert_allclose(seen, pasted_box(box, paste, (128, 96))[0], atol=1.5)
    middle = shown[round(center[1]), round(center[0])]
    # Colour curve, warp and blend round once each.
    np.testing.assert_allclose(middle, 0.8 * np.array([250, 200, 150]), atol=2)


def test_boxes_end_at_the_image() -> None:
    box = np.array([30.0, 21.0, 40.0, 20.0])
    found = pasted_box(box, Paste(0, 1.0, (0.0, 96.0)), (128, 96))
    assert found.tolist() == [[0.0, 86.0, 20.0, 10.0]]


def test_drawn_drogues_are_neither_tiny_nor_much_enlarged() -> None:
    rng, box = np.random.default_rng(0), np.array([5.0, 5.0, 30.0, 20.0])
    pastes = [sample_paste(rng, 4, box, (128, 96)) for _ in range(200)]
    longest = np.array([paste.scale * 30 for paste in pastes])
    assert 0.03 * 96 <= longest.min() < 4 and 40 < longest.max() <= 45
    centers = np.array([paste.center_px for paste in pastes])
    assert (centers >= 0).all() and (centers <= (128, 96)).all()
    assert centers.std(axis=0) == pytest.approx((37, 28), rel=0.15)
    areas = [pasted_box(box, paste, (128, 96))[0, 2:].prod() / (600 * paste.scale**2) for paste in pastes]
    # Half of the box is 0.7 of it along both axes, in a corner; at an edge no less.
    assert min(areas) >= 0.49


def test_a_drogue_that_would_not_be_seen_is_shown_as_its_negative() -> None:
    image = np.full((96, 128, 3), 240, np.uint8)
    cutout, alpha = Cutout(x=20, y=10, width=40, height=40, offset=0), np.full((40, 40), 255, np.uint8)
    background = np.full((96, 128, 3), 250, np.uint8)
    shown = paste_drogue(
        background, image, np.array([20.0, 10.0, 40.0, 40.0]), cutout, alpha, Paste(0, 1.0, (60.0, 40.0))
    )
    assert shown[40, 60].tolist() == [15, 15, 15] and shown[90, 120].tolist() == [250, 250, 250]


@pytest.mark.parametrize(("x", "clear"), [(40.0, False), (59.0, False), (61.0, True)])
def test_pasted_drogues_touch_no_other(x: float, clear: bool) -> None:
    others = np.array([[20.0, 20.0, 40.0, 40.0], [300.0, 300.0, 10.0, 10.0]])
    assert is_clear(np.array([x, 50.0, 2.0, 2.0]), others) is clear
    assert is_clear(np.array([x, 50.0, 2.0, 2.0]), np.zeros((0, 4)))


def test_a_pasted_rectangle_covers_all_that_is_pasted() -> None:
    rng = np.random.default_rng(0)
    image, box = np.full((96, 128, 3), 250, np.uint8), np.array([40.0, 30.0, 20.0, 20.0])
    # The hose leaves to the right and below.
    cutout, alpha = Cutout(x=35, y=25, width=60, height=50, offset=0), np.full((50, 60), 255, np.uint8)
    for _ in range(50):
        paste = sample_paste(rng, 0, box, (128, 96))
        x, y, width, height = pasted_rectangle(box, cutout, paste)
        shown = paste_drogue(np.zeros((96, 128, 3), np.uint8), image, box, cutout, alpha, paste)
        at = np.argwhere(shown.any(axis=2))[:, ::-1]
        # The edge is soft: 0.6 px of blur reach over two pixels.
        assert (at >= np.array([x, y]) - 4).all() and (at <= np.array([x + width, y + height]) + 4).all()
        assert len(at)


def test_looks_change_colours_as_they_say() -> None:
    pixels = np.array([[[200, 100, 50]]], np.uint8)
    assert _repaint(pixels, Look()).tolist() == pixels.tolist()
    assert _repaint(pixels, Look(is_negative=True)).tolist() == [[[55, 155, 205]]]
    grey = _repaint(pixels, Look(saturation=0.0, gain=0.5))[0, 0]
    # Rec. 709: 0.2126 x 200 + 0.7152 x 100 + 0.0722 x 50 = 118, to a rounding of each step.
    np.testing.assert_allclose(grey, 59, atol=1)
    assert _repaint(np.full((1, 1, 3), 51, np.uint8), Look(gamma=2.0))[0, 0].tolist() == [10, 10, 10]


def shares(corpus: Corpus, pasted_fraction: float) -> tuple[float, float]:
    """Of photographs alone the share with a box, and of pairs that with one in both images or in none."""
    changes = {"photograph_fraction": 0.99, "pasted_fraction": pasted_fraction, "mosaic": False}
    maker = BatchMaker(corpus, build_settings(None, {**changes, "size_px": SIZE, "image_passes": 800}))
    batches = [maker.batch(step) for step in range(20)]
    with_box = np.mean([len(boxes) > 0 for batch in batches for boxes in batch.boxes])
    pairs = [(batch.boxes[eye], batch.boxes[eye + 1]) for batch in batches for eye in range(0, 8, 2)]
    both = np.mean([(len(left) > 0) == (len(right) > 0) for left, right in pairs])
    return float(with_box), float(both)


def test_the_wanted_share_of_photographs_shows_a_drogue_to_both_eyes(toy_corpus: Corpus) -> None:
    photographs = Photographs(np.full((3, *SIZE, 3), 200, np.uint8), "0" * 64)
    corpus = replace(toy_corpus, without_drogue=photographs)
    # 80 samples: the standard deviation of the share is 0.06.
    assert shares(corpus, 0.5) == (pytest.approx(0.5, abs=0.18), pytest.approx(1.0, abs=0.05))
    assert shares(corpus, 0.0)[0] < 0.05 and shares(corpus, 1.0)[0] > 0.9


def test_pairs_get_a_second_drogue(toy_corpus: Corpus) -> None:
    def boxes(pasted_fraction: float) -> int:
        changes = {"pasted_fraction": pasted_fraction, "mosaic": False, "size_px": SIZE, "image_passes": 800}
        maker = BatchMaker(toy_corpus, build_settings(None, changes))
        return sum(len(own) for step in range(10) for own in maker.batch(step).boxes)

    # 80 images; a few pastes would touch the image's own drogue, and some views show one of both only.
    assert boxes(1.0) > boxes(0.0) + 20
