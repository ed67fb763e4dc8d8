"""Consistency of the two eyes of a stereo tracker."""

from __future__ import annotations

from dataclasses import replace

import pytest

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES
from nav.detector.detector import Detection, StereoDetection
from nav.tracking.tracker import Tracker, open_tracker, tracker_names
from tests.support.painted_sequences import Place, film, overlap

NOWHERE = StereoDetection(None, None)


def boxes(place: Place) -> StereoDetection:
    """The true boxes."""
    return StereoDetection(*(Detection(place.box(eye), 1.0) for eye in EYES))


def least_overlap(tracker: Tracker, images: StereoImages, place: Place) -> float:
    """Of both eyes with the truth, in the next pair."""
    found = tracker.follow(images, NOWHERE)
    assert found.left is not None and found.right is not None
    return min(overlap(found.left.box_xywh_px, place.box("left")), overlap(found.right.box_xywh_px, place.box("right")))


@pytest.mark.parametrize("name", tracker_names())
def test_an_eye_whose_box_is_beside_the_image_is_not_followed(name: str) -> None:
    places = [Place(300 + 3 * index, 240, 70) for index in range(5)]
    pairs = film(places)
    # Three columns of it are on the image.
    outside = Detection((-67.5, 200.0, 70.0, 70.0), 1.0)
    tracker = open_tracker(name)
    tracker.start(pairs[0], replace(boxes(places[0]), right=outside))
    for images, place in zip(pairs[1:3], places[1:3], strict=True):
        found = tracker.follow(images, NOWHERE)
        assert found.left is not None and found.right is None
        tracker.correct(images, replace(boxes(place), right=outside))
    # The left eye's image goes black; there is no other that could help.
    dark = replace(pairs[3], left=0 * pairs[3].left)
    assert tracker.follow(dark, NOWHERE) == NOWHERE
    tracker.correct(pairs[3], boxes(places[3]))
    # MIL moves in steps of its grid, a thirtieth of the box.
    assert least_overlap(tracker, pairs[4], places[4]) > 0.7


@pytest.mark.parametrize("fooled", EYES)
def test_an_eye_on_a_lookalike_is_corrected_by_the_other(fooled: str) -> None:
    """The drogue jumps, and in one eye something like it stands where the drogue was expected."""
    places = [Place(250, 240, 60)] * 4 + [Place(325, 240, 60), Place(327, 240, 60)]
    pairs = film(places)
    alike = film([places[0]] * 6)[4]
    image = (pairs[4].left if fooled == "left" else pairs[4].right).copy()
    x, y, width, height = (int(value) for value in places[0].box(fooled))
    there = slice(y - 3, y + height + 4), slice(x - 3, x + width + 4)
    image[there] = (alike.left if fooled == "left" else alike.right)[there]
    pairs[4] = replace(pairs[4], left=image) if fooled == "left" else replace(pairs[4], right=image)
    tracker = open_tracker("bernoulli")
    tracker.start(pairs[0], boxes(places[0]))
    for images, place in zip(pairs[1:], places[1:], strict=True):
        assert least_overlap(tracker, images, place) > 0.9


def test_two_searches_of_one_pair_are_one_miss() -> None:
    """Four misses of the right eye, each with a second look after the left one's box, do not make it give up."""
    places = [Place(300 + 2 * index, 240, 60) for index in range(8)]
    pairs, without = film(places), film([replace(place, hidden=True) for place in places])
    pairs[2:6] = [replace(pair, right=empty.right) for pair, empty in zip(pairs[2:6], without[2:6], strict=True)]
    pairs[6] = replace(pairs[6], left=without[6].left)
    tracker = open_tracker("bernoulli")
    tracker.start(pairs[0], boxes(places[0]))
    answers = [tracker.follow(images, NOWHERE) for images in pairs[1:]]
    assert [found.right is None for found in answers] == [False] + [True] * 4 + [False] * 2
    assert [found.left is None for found in answers] == [False] * 5 + [True, False]
