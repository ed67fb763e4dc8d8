"""The search for a ring among blobs: which maps the compiled votes prefer."""

from __future__ import annotations

import numpy as np

from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from nav.matching.marker_channel import Blobs
from nav.matching.ring_matching import _count_votes, _nearest_alike, match_ring

LAYOUT = marker_layout(PRESETS["red-8"])
# Of a marker's radius, as the module has them.
TOLERANCE, SIZE_FACTOR = 0.8, 1.6


def test_votes_are_matched_markers_and_then_their_nearness() -> None:
    rng = np.random.default_rng(3)
    places_m = np.ascontiguousarray(LAYOUT.centers_m[:, :2])
    turns = 900 * np.exp(1j * rng.uniform(-0.15, 0.15, 50)) * rng.uniform(0.9, 1.1, 50)
    shifts = 400 + 300j + rng.normal(0, 8, 50) + 1j * rng.normal(0, 8, 50)
    places = places_m[:, 0] + 1j * places_m[:, 1]
    blobs = np.concatenate([900 * places + 400 + 300j, rng.uniform(0, 800, 10) + 1j * rng.uniform(0, 600, 10)])
    radii_px = np.concatenate([np.full(LAYOUT.count, 900 * LAYOUT.radius_m), rng.uniform(1, 60, 10)])
    centers_px = np.stack([blobs.real, blobs.imag], axis=1)
    votes = _count_votes(turns, shifts, places_m, centers_px, radii_px, LAYOUT.radius_m)
    assert len(set(np.floor(votes))) > 3
    for turn, shift, vote in zip(turns, shifts, votes, strict=True):
        radius_px = LAYOUT.radius_m * abs(turn)
        alike = (radii_px < SIZE_FACTOR * radius_px) & (radius_px < SIZE_FACTOR * radii_px)
        gaps_px = np.abs((turn * places + shift)[:, None] - blobs[alike]).min(axis=1)
        nearness = np.maximum(0, 1 - gaps_px / (TOLERANCE * radius_px))
        np.testing.assert_allclose(vote, (nearness > 0).sum() + nearness.mean() / 2, rtol=0, atol=1e-9)


def test_the_nearest_blob_of_a_like_size_belongs_to_a_place() -> None:
    rng = np.random.default_rng(6)
    places_px, centers_px = rng.uniform(0, 100, (300, 2)), rng.uniform(0, 100, (40, 2))
    radii_px = rng.uniform(4, 20, 40)
    gaps_px = np.hypot(*(places_px[:, None] - centers_px).transpose(2, 0, 1))
    gaps_px[:, (radii_px >= SIZE_FACTOR * 9) | (SIZE_FACTOR * radii_px <= 9)] = np.inf
    expected = np.where(gaps_px.min(axis=1) < 7, gaps_px.argmin(axis=1), -1)
    assert 0 < (expected >= 0).sum() < 300
    assert _nearest_alike(places_px, 9.0, 7.0, centers_px, radii_px).tolist() == expected.tolist()
    assert _nearest_alike(places_px, 9.0, 7.0, centers_px[:0], radii_px[:0]).tolist() == [-1] * 300


def test_a_ring_is_found_among_other_blobs() -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        turn = rng.uniform(300, 900) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        places_px = turn * (LAYOUT.centers_m[:, 0] + 1j * LAYOUT.centers_m[:, 1]) + 640 + 480j
        radius_px = abs(turn) * LAYOUT.radius_m
        others_px = rng.uniform(0, 1280, 6) + 1j * rng.uniform(0, 960, 6)
        centers = np.concatenate([places_px, others_px])
        order = rng.permutation(len(centers))
        areas_px2 = np.pi * np.concatenate([np.full(LAYOUT.count, radius_px), rng.uniform(2, 40, 6)]) ** 2
        match = match_ring(Blobs(np.stack([centers.real, centers.imag], axis=1)[order], areas_px2[order]), LAYOUT)
        assert match is not None and match.count == LAYOUT.count
        assert set(order[match.blob_of_marker]) == set(range(LAYOUT.count))
