from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.random_streams import sample_generator
from nav.training.corpus import Corpus
from nav.training.trainer import BatchMaker, Member
from nav.training.training_settings import build_settings


def test_streams_differ_by_every_part_of_their_key() -> None:
    keys = [(0, 0, 0, "a"), (1, 0, 0, "a"), (2**40, 0, 0, "a"), (0, 1, 0, "a"), (0, 0, 1, "a"), (0, 0, 0, "b")]
    assert len({sample_generator(*key).integers(2**62) for key in keys}) == len(keys)
    with pytest.raises(ValueError, match="must not be negative"):
        sample_generator(0, -1, 0, "a")


@pytest.mark.parametrize("views", ["one", "both"])
def test_batches_depend_on_their_number_alone(ellipse_corpus: Corpus, views: str) -> None:
    settings = build_settings(None, {"size_px": (96, 128), "views": views, "batch_images": 4, "image_passes": 40})
    maker = BatchMaker(ellipse_corpus, settings)
    alone = [maker.batch(step) for step in (5, 3, 4)]
    for workers in (1, 2):
        ahead = list(BatchMaker(ellipse_corpus, settings).batches(range(3, 6), workers))
        for mine, theirs in zip((alone[1], alone[2], alone[0]), ahead, strict=True):
            np.testing.assert_array_equal(mine.images, theirs.images)
            for own, of_worker in zip(mine.boxes, theirs.boxes, strict=True):
                np.testing.assert_array_equal(own, of_worker, strict=True)


def test_both_eyes_get_the_same_geometry_and_their_own_noise(ellipse_corpus: Corpus) -> None:
    # Both eyes of this corpus see the same, so boxes differ only where one eye's drogue was occluded.
    settings = build_settings(None, {"size_px": (96, 128), "views": "both", "batch_images": 8, "image_passes": 400})
    maker = BatchMaker(ellipse_corpus, settings)
    equal = images_equal = pairs = 0
    for step in range(12):
        batch = maker.batch(step)
        for left in range(0, 8, 2):
            pairs += 1
            equal += np.array_equal(batch.boxes[left], batch.boxes[left + 1])
            images_equal += np.array_equal(batch.images[left], batch.images[left + 1])
    # An eighth of about 2.5 drogues an image, in either eye, of which some stay as they are.
    assert pairs / 4 < equal and images_equal < pairs / 10


def test_an_epoch_shows_every_image_once(ellipse_corpus: Corpus) -> None:
    shown: list[tuple[int, int]] = []

    class Watched(BatchMaker):
        def _members(self, sample: int) -> list[Member]:
            members = super()._members(sample)
            shown.extend((pair, eye) for pair, eye, _ in members)
            return members

    settings = build_settings(
        None, {"size_px": (96, 128), "mosaic": False, "views": "one", "batch_images": 6, "image_passes": 480}
    )
    maker = Watched(ellipse_corpus, settings)
    for step in range(8):
        maker.batch(step)
    everything = sorted((pair, eye) for pair in range(12) for eye in (0, 1))
    assert sorted(shown[:24]) == everything and sorted(shown[24:]) == everything
    assert shown[:24] != shown[24:]
    assert [maker.epoch_after(step) for step in (0, 3, 4, 8)] == [0, 0, 1, 2]


def test_the_last_part_is_larger_and_without_mosaic(ellipse_corpus: Corpus) -> None:
    changes = {"size_px": (64, 96), "final_size_px": (96, 128), "batch_images": 4, "image_passes": 120}
    changes |= {"final_fraction": 1 / 3, "plain_fraction": 0.2}
    settings = build_settings(None, changes)
    maker = BatchMaker(ellipse_corpus, settings)
    assert [maker.batch(step).images.shape[1:3] for step in (0, 19, 20, 29)] == [(64, 96)] * 2 + [(96, 128)] * 2
    assert [settings.mosaic_at(step) for step in (0, 23, 24, 29)] == [True, True, False, False]
    # One image has at most one drogue.
    assert max(len(boxes) for step in range(24, 30) for boxes in maker.batch(step).boxes) == 1
    assert max(len(boxes) for step in range(6) for boxes in maker.batch(step).boxes) > 1


@pytest.mark.parametrize("fraction", [0.0, 0.5, 1.0])
def test_the_share_of_mosaics_is_that_of_the_settings(ellipse_corpus: Corpus, fraction: float) -> None:
    changes = {"size_px": (96, 128), "batch_images": 4, "image_passes": 240, "plain_fraction": 0.0}
    maker = BatchMaker(ellipse_corpus, build_settings(None, {**changes, "mosaic_fraction": fraction}))
    # The eyes of a pair share the draw. Four drogues in a mosaic, unless some are cut off; at most one in other images.
    mosaics = [max(map(len, maker.batch(step).boxes[left : left + 2])) > 1 for step in range(60) for left in (0, 2)]
    # Four standard deviations of 120 draws.
    assert abs(sum(mosaics) / len(mosaics) - fraction) <= 4 * (fraction * (1 - fraction) / len(mosaics)) ** 0.5
