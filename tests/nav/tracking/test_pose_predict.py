"""Tracker `pose-predict`: the compiled search for the shift, and the planes of colour."""

from __future__ import annotations

import numpy as np
import pytest

from nav.tracking.pose_predict import _best_shift, _color_plane, _plane_count, learn_constellation
from nav.tracking.region import EyeImage

TOLERANCE_PX = 4.0


def test_the_best_shift_is_that_of_most_matches_and_then_least_error() -> None:
    rng = np.random.default_rng(5)
    for _ in range(30):
        places_px = rng.uniform(0, 100, (8, 2))
        kept = places_px[rng.random(8) < 0.8]
        spots_px = np.concatenate([kept + rng.normal(0, 1, kept.shape) + (7, -3), rng.uniform(0, 100, (4, 2))])
        shift_px, matches, error_px = _best_shift(places_px, spots_px, TOLERANCE_PX)
        shifts_px = (spots_px[:, None] - places_px).reshape(-1, 2)
        gaps_px = np.linalg.norm((places_px + shifts_px[:, None])[:, :, None] - spots_px, axis=3).min(axis=2)
        counts, errors_px = (gaps_px < TOLERANCE_PX).sum(axis=1), np.minimum(gaps_px, TOLERANCE_PX).sum(axis=1)
        best = np.lexsort((errors_px, -counts))[0]
        assert matches == counts[best]
        np.testing.assert_allclose(error_px, errors_px[best], rtol=0, atol=1e-9)
        np.testing.assert_allclose(shift_px, shifts_px[best], rtol=0, atol=1e-9)


@pytest.mark.parametrize("plane", [0, 1, 2, 3])
def test_planes_are_colours_minus_the_larger_other_one_and_the_smallest(plane: int) -> None:
    pixels = np.random.default_rng(6).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    assert _plane_count(pixels) == 4
    colours = pixels.astype(int)
    expected = colours.min(axis=2)
    if plane < 3:
        others = np.delete(colours, plane, axis=2).max(axis=2)
        expected = np.maximum(colours[:, :, plane] - others, 0)
    np.testing.assert_array_equal(_color_plane(pixels, plane), expected)


def test_spots_are_found_again_where_the_box_has_moved_to() -> None:
    rows, columns = np.mgrid[:300, :400]
    angles = 2 * np.pi * np.arange(8) / 8

    def picture(x_px: float, y_px: float) -> EyeImage:
        middles = np.stack([x_px + 80 * np.cos(angles), y_px + 80 * np.sin(angles)], axis=1)
        nearest_px = np.hypot(columns[..., None] - middles[:, 0], rows[..., None] - middles[:, 1]).min(axis=2)
        return EyeImage((200 * np.clip(8.5 - nearest_px, 0, 1)).astype(np.uint8), 0.0)

    constellation = learn_constellation(picture(200, 150), (100, 50, 200, 200))
    assert constellation is not None and len(constellation.places) == 8
    found = constellation.find(picture(206, 146), (100, 50, 200, 200), 20.0)
    assert found is not None and found[1] == 1
    # Middles of masks of discs of 8 px err by less than half a pixel.
    np.testing.assert_allclose(found[0], (106, 46, 200, 200), rtol=0, atol=1)
