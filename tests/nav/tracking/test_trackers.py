"""Every tracker on painted sequences: it follows the drogue, and detects its loss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES
from nav.detector.detector import Detection, StereoDetection
from nav.tracking.tracker import Tracker, open_tracker, tracker_names
from tests.support.painted_sequences import Look, Place, film, growing, overlap, swing

NOWHERE = StereoDetection(None, None)
# The binary chain widens boxes by 6 % a side; what is smaller by no more than that still holds all markers.
ALL_MARKERS_INSIDE = 1 / 1.12**2
# Its grid is 1/32 of the box; a tenth of that each way.
WELL_ALIGNED = 0.98
SKY_AND_DARK = [Look(), Look(light=0.12, noise_dn=1.5), Look(bits=12, light=0.05, noise_dn=0.5)]


def boxes(place: Place) -> StereoDetection:
    """The true boxes."""
    return StereoDetection(*(Detection(place.box(eye), 1.0) for eye in EYES))


def overlaps(tracker: Tracker, pairs: list[StereoImages], places: list[Place]) -> np.ndarray:
    """(n - 1, 2) with the truth, from the second pair on, without help after the first; NaN where there is no box."""
    tracker.start(pairs[0], boxes(places[0]))
    rows = []
    for images, place in zip(pairs[1:], places[1:], strict=True):
        found = tracker.follow(images, NOWHERE)
        answers = [found.of(eye) for eye in EYES]
        rows.append(
            [np.nan if a is None else overlap(a.box_xywh_px, place.box(e)) for a, e in zip(answers, EYES, strict=True)]
        )
    return np.array(rows)


@pytest.mark.parametrize(("name", "size"), [("bernoulli", 16), ("bernoulli", 60), ("flow", 60), ("pose-predict", 60)])
def test_motion_of_sixty_pixels_per_frame(name: str, size: float) -> None:
    places = swing(size, 16)
    steps = np.hypot(*np.diff([(place.x, place.y) for place in places], axis=0).T)
    assert steps.max() > 60
    assert overlaps(open_tracker(name), film(places), places).min() > 0.95


@pytest.mark.parametrize("look", SKY_AND_DARK, ids=["sky", "dark 8 bit", "dark 12 bit"])
@pytest.mark.parametrize("name", ["bernoulli", "flow", "pose-predict"])
def test_an_approach_keeps_all_markers_in_the_box(name: str, look: Look) -> None:
    places = growing(28, 220, 32)
    assert overlaps(open_tracker(name), film(places, look), places).min() > ALL_MARKERS_INSIDE


def test_an_approach_from_16_to_700_px_ends_beyond_the_image() -> None:
    places = growing(16, 700, 64)
    found = overlaps(open_tracker("bernoulli"), film(places), places)
    whole = np.array([place.size < 440 for place in places[1:]])
    assert found[whole].min() > WELL_ALIGNED
    # Of the last boxes a third is not on the image, and no edge of the rim is seen along two sides.
    assert found.min() > 0.7


def test_bernoulli_follows_a_drogue_of_eight_pixels() -> None:
    places = swing(8, 12)
    # A fifth of a pixel each way.
    assert overlaps(open_tracker("bernoulli"), film(places), places).min() > 0.9


def test_bernoulli_ignores_a_moving_background() -> None:
    places = swing(60, 16)
    assert overlaps(open_tracker("bernoulli"), film(places, Look(ground=True)), places).min() > ALL_MARKERS_INSIDE


# In grey, markers run together with the sky where the dark margin around them is no wider than a pixel.
@pytest.mark.parametrize(("name", "size"), [("bernoulli", 40), ("flow", 40), ("pose-predict", 260)])
def test_a_mono_image_is_followed(name: str, size: float) -> None:
    places = growing(size, 1.5 * size, 12)
    assert overlaps(open_tracker(name), film(places, Look(is_mono=True)), places).min() > ALL_MARKERS_INSIDE


@pytest.mark.parametrize(
    ("name", "ground"),
    # MIL sits on the fields where the drogue was, and fields look like the fields that it saw around and through it.
    [(name, ground) for name in tracker_names() for ground in (False, True) if (name, ground) != ("mil", True)],
)
def test_a_hidden_drogue_has_no_box(name: str, ground: bool) -> None:
    places = [Place(300 + 4 * index, 240 + 2 * index, 70, hidden=index >= 6) for index in range(20)]
    look = Look(ground=ground, noise_dn=1.5)
    found = overlaps(open_tracker(name), film(places, look), places)
    if name == "bernoulli" or not ground:
        assert found[:5].min() > 0.7
    # Three pairs are what a tracker may need to see that nothing comes back.
    assert np.isnan(found[8:]).all()


@pytest.mark.parametrize("name", ["bernoulli", "flow", "pose-predict"])
def test_a_drogue_that_leaves_the_image_has_no_box(name: str) -> None:
    places = [Place(480 + 15 * index, 240, 80) for index in range(20)]
    found = overlaps(open_tracker(name), film(places), places)
    inside = [place.x + place.size / 2 < 640 for place in places[1:]]
    outside = [place.x - place.size / 2 > 640 for place in places[1:]]
    assert found[inside].min() > ALL_MARKERS_INSIDE
    assert np.isnan(found[outside, 0]).all()


@pytest.mark.parametrize("name", tracker_names())
def test_an_eye_is_followed_from_its_first_box_on(name: str) -> None:
    places = [Place(300 + 3 * index, 240, 70) for index in range(6)]
    pairs = film(places)
    tracker = open_tracker(name)
    tracker.start(pairs[0], replace(boxes(places[0]), right=None))
    found = tracker.follow(pairs[1], NOWHERE)
    assert found.left is not None and found.right is None
    tracker.correct(pairs[1], replace(boxes(places[1]), left=None))
    found = tracker.follow(pairs[2], NOWHERE)
    assert found.right is not None
    # MIL moves in steps of its grid, a thirtieth of the box.
    assert overlap(found.right.box_xywh_px, places[2].box("right")) > 0.8


@pytest.mark.parametrize("name", tracker_names())
def test_a_box_beside_the_image_is_not_followed(name: str) -> None:
    pairs = film([Place(300, 240, 70)] * 2)
    tracker = open_tracker(name)
    outside = StereoDetection(Detection((900.0, 10.0, 50.0, 50.0), 1.0), Detection((-60.0, 10.0, 58.0, 50.0), 1.0))
    tracker.start(pairs[0], outside)
    assert tracker.follow(pairs[1], NOWHERE) == NOWHERE


def test_a_correction_moves_bernoulli_to_where_it_points() -> None:
    wrong, true = Place(300, 240, 70), Place(318, 240, 84)
    pairs = film([true] * 3)
    tracker = open_tracker("bernoulli")
    tracker.start(pairs[0], boxes(wrong))
    tracker.follow(pairs[1], NOWHERE)
    tracker.correct(pairs[1], boxes(true))
    found = tracker.follow(pairs[2], NOWHERE).left
    assert found is not None and overlap(found.box_xywh_px, true.box("left")) > WELL_ALIGNED


@pytest.mark.parametrize("name", ["bernoulli", "flow", "pose-predict"])
def test_a_prediction_replaces_the_tracker_s_own(name: str) -> None:
    """A step that no motion so far explains, with a box that does."""
    places = [Place(150, 200, 60), Place(150, 200, 60), Place(450, 330, 60)]
    pairs = film(places)
    tracker = open_tracker(name)
    tracker.start(pairs[0], boxes(places[0]))
    tracker.follow(pairs[1], NOWHERE)
    near = StereoDetection(*(Detection(Place(445, 333, 61).box(eye), 1.0) for eye in EYES))
    found = tracker.follow(pairs[2], near).left
    assert found is not None and overlap(found.box_xywh_px, places[2].box("left")) > 0.9


def test_an_eye_that_lost_the_drogue_searches_where_the_other_sees_it() -> None:
    """Something hides it from the right eye while it turns back."""
    places = [Place(200 + 20 * index, 240, 60) for index in range(5)]
    places += [Place(280 - 25 * index, 240, 60) for index in range(1, 7)]
    pairs = film(places)
    blind = film([replace(place, hidden=True) for place in places])
    pairs[5:8] = [replace(seen, right=hidden.right) for seen, hidden in zip(pairs[5:8], blind[5:8], strict=True)]
    found = overlaps(open_tracker("bernoulli"), pairs, places)
    assert found[:, 0].min() > 0.9
    assert np.isnan(found[4:7, 1]).all()
    assert found[7:, 1].min() > 0.9


@pytest.mark.parametrize("name", tracker_names())
def test_the_same_pairs_give_the_same_boxes(name: str) -> None:
    places = [Place(300 + 6 * index, 240 - 3 * index, 60 + index) for index in range(6)]
    pairs = film(places, Look(noise_dn=2.0))
    runs: list[list[tuple[float, ...]]] = []
    for _ in range(2):
        tracker = open_tracker(name)
        tracker.start(pairs[0], boxes(places[0]))
        answers = [tracker.follow(images, NOWHERE) for images in pairs[1:]]
        runs.append([one.box_xywh_px for found in answers for eye in EYES if (one := found.of(eye)) is not None])
    assert len(runs[0]) == 2 * (len(places) - 1)
    # The same arithmetic twice in one process: nothing but a draw or a leftover could differ.
    np.testing.assert_allclose(*runs, rtol=0, atol=1e-6)


def test_a_tracker_that_does_not_exist() -> None:
    with pytest.raises(ValueError, match="tracker: must be one of bernoulli, flow, mil, pose-predict, got 'csrt'"):
        open_tracker("csrt")
