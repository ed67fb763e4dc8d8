"""OpenCV's MIL as a tracker: boxes that it cannot start with, the image's edge, and loss."""

from __future__ import annotations

import pytest

from nav.detector.detector import Detection, StereoDetection
from nav.tracking.tracker import open_tracker
from tests.support.painted_sequences import Place, film, overlap

NOWHERE = StereoDetection(None, None)


def left_box(place: Place) -> StereoDetection:
    """The true box of the left eye alone."""
    return StereoDetection(Detection(place.box("left"), 1.0), None)


def test_mil_keeps_its_initial_size() -> None:
    places = [Place(320 + 3 * index, 240, 60 * 1.01**index) for index in range(8)]
    pairs = film(places)
    tracker = open_tracker("mil")
    tracker.start(pairs[0], left_box(places[0]))
    for images, place in zip(pairs[1:], places[1:], strict=True):
        left = tracker.follow(images, NOWHERE).left
        assert left is not None and left.box_xywh_px[2:] == (60, 60)
        # Its answers are whole pixels, and it has no notion of the drogue's middle.
        assert abs(left.box_xywh_px[0] + 30 - place.x) < 6


@pytest.mark.parametrize("size", [4, 5, 520, 700])
def test_a_box_that_opencv_cannot_start_with_is_lost(size: float) -> None:
    place = Place(320, 240, size)
    pairs = film([place] * 2)
    tracker = open_tracker("mil")
    tracker.start(pairs[0], left_box(place))
    assert tracker.follow(pairs[1], NOWHERE) == NOWHERE


@pytest.mark.parametrize(("x", "y"), [(20, 240), (320, 465), (622, 462)])
def test_a_box_over_the_edge_is_followed_about_its_own_centre(x: float, y: float) -> None:
    """A fifth of the box or more is not on the image."""
    places = [Place(x, y, 80), Place(x + 1, y, 80)]
    # MIL is off by some pixels of its grid, 1.25 px each: 6 px each way leave this.
    assert after_the_first(places) > 0.7


def test_after_a_loss_a_correction_restarts_mil() -> None:
    """While nothing is there MIL wanders off, and does not say so."""
    assert after_a_correction() > 0.7


def after_the_first(places: list[Place]) -> float:
    """Overlap in the second pair; 0 without a box."""
    pairs = film(places)
    tracker = open_tracker("mil")
    tracker.start(pairs[0], left_box(places[0]))
    left = tracker.follow(pairs[1], NOWHERE).left
    return 0.0 if left is None else overlap(left.box_xywh_px, places[1].box("left"))


def after_a_correction() -> float:
    """Overlap in the pair after one that came back where it was; 0 without a box."""
    places = [Place(300, 240, 60, hidden=1 <= index <= 6) for index in range(9)]
    pairs = film(places)
    tracker = open_tracker("mil")
    tracker.start(pairs[0], left_box(places[0]))
    for images in pairs[1:8]:
        tracker.follow(images, NOWHERE)
    tracker.correct(pairs[7], left_box(places[7]))
    left = tracker.follow(pairs[8], NOWHERE).left
    return 0.0 if left is None else overlap(left.box_xywh_px, places[8].box("left"))
