"""A detector that starts and restarts a tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from drogue_models.presets import load_drogue
from geometry.stereo import EYES
from nav.detector.detector import Detection, StereoDetection
from nav.detector.ring_detectors import ColorBlobDetector
from nav.tracked_detection import TrackedDetector, tracked_detector_factory
from nav.tracking.tracker import MOST_UNCONFIRMED, REDETECT_EVERY, begins_sequence, open_tracker
from tests.support.painted_sequences import RATE_HZ, Look, Place, film, overlap


class CountingDetector(ColorBlobDetector):
    """A detector that counts its calls."""

    asked = 0

    def detect(self, images: StereoImages) -> StereoDetection:
        self.asked += 1
        return super().detect(images)


def tracked(name: str = "bernoulli") -> tuple[TrackedDetector, CountingDetector]:
    """A tracked detector that has nothing to track yet."""
    detector = CountingDetector(load_drogue("red-8"))
    return TrackedDetector(detector, open_tracker(name)), detector


def overlaps(found: StereoDetection, place: Place) -> list[float]:
    """Of both eyes; NaN without a box."""
    boxes = [(found.of(eye), place.box(eye)) for eye in EYES]
    return [np.nan if one is None else overlap(one.box_xywh_px, box) for one, box in boxes]


@pytest.mark.parametrize("name", ["bernoulli", "flow", "pose-predict"])
def test_the_detector_runs_once_while_the_drogue_is_followed(name: str) -> None:
    following, detector = tracked(name)
    places = [Place(300 + 5 * index, 240, 80) for index in range(8)]
    for images, place in zip(film(places), places, strict=True):
        assert min(overlaps(following.detect(images), place)) > 0.9
    assert detector.asked == 1
    assert following.name == f"color-blob+{name}"


@pytest.mark.parametrize("name", ["bernoulli", "flow", "mil", "pose-predict"])
def test_the_drogue_is_found_again_after_two_seconds_of_occlusion(name: str) -> None:
    following, _ = tracked(name)
    places = [Place(300, 200 + index, 80, hidden=4 <= index < 54) for index in range(58)]
    pairs = zip(film(places), places, strict=True)
    seen = np.array([overlaps(following.detect(images), place) for images, place in pairs])
    assert seen[:4].min() > 0.8
    # Lost within a few pairs, and found again within three of its return.
    assert np.isnan(seen[7:54]).all()
    assert seen[56].min() > 0.9


def test_the_eye_that_is_blinded_is_found_again_while_the_other_is_followed() -> None:
    following, detector = tracked()
    places = [Place(300 + 3 * index, 240, 80) for index in range(24)]
    pairs, without = film(places), film([replace(place, hidden=True) for place in places])
    pairs[4:20] = [replace(pair, left=empty.left) for pair, empty in zip(pairs[4:20], without[4:20], strict=True)]
    seen = np.array([overlaps(following.detect(images), place) for images, place in zip(pairs, places, strict=True)])
    assert seen[:, 1].min() > 0.9
    assert np.isnan(seen[7:20, 0]).all()
    assert seen[22].min() > 0.9
    # At every third pair of the sixteen, and in the first one.
    assert detector.asked <= 7


def test_a_gap_in_time_starts_a_new_sequence() -> None:
    following, detector = tracked()
    first, second = Place(200, 150, 60), Place(450, 300, 90)
    pairs = film([first] * 3) + film([second] * 2, start_s=10.0) + film([first], start_s=0.0)
    places = [first] * 3 + [second] * 2 + [first]
    for images, place in zip(pairs, places, strict=True):
        assert min(overlaps(following.detect(images), place)) > 0.9
    # The third start is a step back in time.
    assert detector.asked == 3


def test_pairs_of_one_time_are_no_sequence() -> None:
    following, detector = tracked()
    place = Place(200, 150, 60)
    pair = film([place])[0]
    for _ in range(2):
        assert min(overlaps(following.detect(pair), place)) > 0.9
    assert detector.asked == 2
    assert [begins_sequence(last_s, 5.0) for last_s in (None, 3.9, 4.1, 4.96, 5.0, 5.1)] == [
        True,
        True,
        False,
        False,
        True,
        True,
    ]


def test_another_image_format_restarts_the_tracker() -> None:
    """The tests of colours and the template of three channels mean nothing in grey, nor those of 12 bits in 8."""
    following, detector = tracked()
    place = Place(300, 240, 120)
    looks = [Look(), Look(bits=12), Look(is_mono=True), Look()]
    for number, look in enumerate(looks):
        pairs = film([place] * 2, look, start_s=0.08 * number)
        found = [following.detect(images) for images in pairs]
        if not look.is_mono:
            assert min(min(overlaps(each, place)) for each in found) > 0.9
    # Twice in grey, in which this detector finds nothing.
    assert detector.asked == 5


def test_a_false_first_box_is_corrected_by_a_later_detection() -> None:
    """Something like the drogue, but smaller, is taken for it once; then the detector looks a second later."""
    true, false = Place(430, 240, 120), Place(150, 240, 60)
    pair, other = film([true])[0], film([false])[0]
    left, right = pair.left.copy(), pair.right.copy()
    left[:, :200], right[:, :200] = other.left[:, :200], other.right[:, :200]
    pairs = [replace(pair, left=left, right=right, time_s=index / RATE_HZ) for index in range(REDETECT_EVERY + 2)]
    wrong = StereoDetection(*(Detection(false.box(eye), 1.0) for eye in EYES))

    class WrongAtFirst(CountingDetector):
        """A detector whose first result is wrong."""

        def detect(self, images: StereoImages) -> StereoDetection:
            found = super().detect(images)
            return wrong if self.asked == 1 else found

    detector = WrongAtFirst(load_drogue("red-8"))
    following = TrackedDetector(detector, open_tracker("bernoulli"))
    found = [following.detect(images) for images in pairs]
    assert min(overlaps(found[REDETECT_EVERY - 1], false)) > 0.9
    assert min(min(overlaps(each, true)) for each in found[REDETECT_EVERY:]) > 0.9
    assert detector.asked == 2


class ForgetfulDetector(CountingDetector):
    """A detector that knows the drogue at some of its calls alone."""

    def __init__(self, knows: tuple[int, ...]) -> None:
        super().__init__(load_drogue("red-8"))
        self._knows = knows

    def detect(self, images: StereoImages) -> StereoDetection:
        found = super().detect(images)
        return found if self.asked in self._knows else StereoDetection(None, None)


def still_pairs(count: int) -> list[StereoImages]:
    (pair,) = film([Place(300, 240, 60)])
    return [replace(pair, time_s=index / RATE_HZ) for index in range(count)]


@pytest.mark.parametrize("name", ["bernoulli", "flow", "pose-predict"])
def test_what_the_detector_does_not_find_at_three_checks_is_followed_no_longer(name: str) -> None:
    detector = ForgetfulDetector(knows=(1,))
    following = TrackedDetector(detector, open_tracker(name))
    found = [following.detect(images).left is not None for images in still_pairs(MOST_UNCONFIRMED + 10)]
    assert MOST_UNCONFIRMED == 3 * REDETECT_EVERY
    assert found == [True] * MOST_UNCONFIRMED + [False] * 10
    # At the start, at three checks, and from then on at every pair.
    assert detector.asked == 1 + 3 + 9


def test_a_drogue_that_the_detector_overlooks_twice_is_followed() -> None:
    detector = ForgetfulDetector(knows=(1, 4, 7))
    following = TrackedDetector(detector, open_tracker("flow"))
    assert all(following.detect(images).left is not None for images in still_pairs(6 * REDETECT_EVERY + 10))
    assert detector.asked == 7


def test_without_a_drogue_the_detector_runs_at_every_pair() -> None:
    following, detector = tracked()
    for images in film([Place(300, 240, 80, hidden=True)] * 3):
        assert following.detect(images) == StereoDetection(None, None)
    assert detector.asked == 3


def test_candidates_are_the_answer_by_score() -> None:
    following, _ = tracked()
    pairs = film([Place(300, 240, 80)] * 2)
    following.detect(pairs[0])
    found = following.candidates(pairs[1], 0.5)
    assert [len(found[eye]) for eye in EYES] == [1, 1]
    assert following.candidates(pairs[1], 1.01) == {"left": (), "right": ()}


def test_the_factory_keeps_the_tracker_of_one_drogue() -> None:
    known, other = load_drogue("red-8"), load_drogue("red-7")
    of = tracked_detector_factory(ColorBlobDetector, "bernoulli")
    first = of(known)
    assert of(known) is first
    assert of(other) is not first
    with pytest.raises(ValueError, match="tracker: must be one of"):
        tracked_detector_factory(ColorBlobDetector, "none")
