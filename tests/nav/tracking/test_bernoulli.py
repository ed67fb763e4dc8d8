"""The learned comparisons of pixel pairs."""

from __future__ import annotations

import numpy as np
import pytest

from nav.tracking.bernoulli import PixelComparisonFeatures
from nav.tracking.region import EyeImage, ImageRegion, box_center, image_region
from tests.support.painted_sequences import Look, Place, film

PLACE = Place(320, 240, 96)
BOX = PLACE.box("left")


def whole(place: Place, look: Look) -> ImageRegion:
    """The whole image on the grid of the box."""
    pixels = film([place, place], look)[1].left
    region = image_region(EyeImage(pixels, 0.0), (-0.5, -0.5, 640, 480), 3.0)
    assert region is not None
    return region


def learned_at(place: Place, look: Look) -> PixelComparisonFeatures:
    return PixelComparisonFeatures(whole(place, look), place.box("left"), 256, np.random.default_rng(1))


def at(*offsets_px: tuple[float, float]) -> np.ndarray:
    """Candidates of the box's own size."""
    return np.array([[*(box_center(BOX) + offset), 0.0] for offset in offsets_px])


@pytest.mark.parametrize(
    "look", [Look(), Look(ground=True), Look(light=0.1, noise_dn=1.5)], ids=["sky", "ground", "dark"]
)
def test_the_drogue_scores_one_and_all_else_much_less(look: Look) -> None:
    tests = learned_at(PLACE, look)
    # Expected is the mean over misplacements by a thirty-second of the box, 3 px, each way; sizes are not varied here.
    steps = [-3, 0, 3]
    here = tests.scores(whole(PLACE, look), BOX, at(*((x, y) for x in steps for y in steps)))
    assert here.mean() == pytest.approx(1.0, abs=0.2)
    assert here[4] >= here.mean()
    x, y = np.meshgrid(np.arange(80, 561, 8), np.arange(80, 401, 8))
    far = np.hypot(x - PLACE.x, y - PLACE.y) > 0.45 * PLACE.size
    elsewhere = np.column_stack([x[far], y[far], np.zeros(far.sum())])
    assert tests.scores(whole(PLACE, look), BOX, elsewhere).max() < 0.5


def test_the_score_drops_when_the_drogue_is_gone() -> None:
    gone = Place(PLACE.x, PLACE.y, PLACE.size, hidden=True)
    assert learned_at(PLACE, Look()).scores(whole(gone, Look()), BOX, at((0, 0)))[0] < 0


def test_the_score_is_invariant_to_gain() -> None:
    """A picture of two thirds of the light, as a meter may leave it."""
    dimmer = learned_at(PLACE, Look()).scores(whole(PLACE, Look(light=0.67)), BOX, at((0, 0)))
    assert dimmer[0] > 0.8


def test_a_candidate_beyond_the_image_has_no_score() -> None:
    tests = learned_at(PLACE, Look())
    scores = tests.scores(whole(PLACE, Look()), BOX, at((-400, 0), (0, 0)))
    assert scores[0] == -np.inf and np.isfinite(scores[1])


def test_pass_rates_stay_within_their_bounds() -> None:
    """Beta posteriors with forgetting: equal outcomes never give certainty, and a new appearance is accepted."""
    tests, dark = learned_at(PLACE, Look()), whole(PLACE, Look(light=0.2))
    before = tests.scores(dark, BOX, at((0, 0)))[0]
    for _ in range(200):
        tests.learn(dark, BOX)
    after = tests.scores(dark, BOX, at((0, 0)))[0]
    assert after > before
    assert np.isfinite(after)
