"""The weight of the other colours that cancels the brightness step at the rim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.types.images import StereoImages
from nav.matching.marker_channel import OTHERS_WEIGHTS, PLAIN, balancing_weight, marker_channel

MIDDLES_PX = np.array([[60.0, 50.0], [58.0, 50.0]])
RIM_PX = 12.0
BLACK = 4


def pictures(
    sky: tuple[int, ...], face: tuple[int, ...] = (6, 6, 6), size: tuple[int, int] = (100, 120)
) -> StereoImages:
    """A dark disc before an even sky, the same in both eyes. [DN above black]"""
    rows, columns = np.ogrid[: size[0], : size[1]]
    eyes = []
    for u, v in MIDDLES_PX:
        image = np.empty((*size, 3), np.uint8)
        image[:] = np.array(sky) + BLACK
        image[np.hypot(columns - u, rows - v) <= RIM_PX] = np.array(face) + BLACK
        eyes.append(image)
    return StereoImages(*eyes, 0.0, 1e-3, 8, "linear", float(BLACK), None, None)


@pytest.mark.parametrize("sky", [(40, 80, 160), (90, 90, 90), (150, 120, 100)])
def test_the_sky_has_no_lead_left(sky: tuple[int, ...]) -> None:
    weight = balancing_weight(pictures(sky), 0, MIDDLES_PX, RIM_PX)
    assert sky[0] - weight * max(sky[1:]) == pytest.approx(0.0, abs=1e-9)


def test_what_the_drogue_itself_shows_does_not_count() -> None:
    one, other = (
        balancing_weight(pictures((60, 90, 120), face), 0, MIDDLES_PX, RIM_PX) for face in ((6,) * 3, (200, 0, 0))
    )
    assert one == other


def test_a_sky_of_the_markers_own_colour_is_taken_off_in_part() -> None:
    assert balancing_weight(pictures((200, 20, 10)), 0, MIDDLES_PX, RIM_PX) == 1.6


def test_black_night_and_a_drogue_beyond_the_image_change_nothing() -> None:
    assert balancing_weight(pictures((0, 0, 0)), 0, MIDDLES_PX, RIM_PX) == PLAIN
    away = np.array([[500.0, 500.0], [-300.0, 40.0]])
    assert balancing_weight(pictures((60, 90, 120)), 0, away, RIM_PX, 1.4) == 1.4


@pytest.mark.parametrize("window", [(0, 0, 120, 100), (37, 21, 80, 64), (64, 50, 119, 99), (101, 0, 120, 33)])
@pytest.mark.parametrize("color", [0, 1, 2, None])
@pytest.mark.parametrize("kind", ["linear", "gamma", "mono", "mosaic"])
def test_part_of_the_channel_is_that_part_of_the_whole(window: tuple[int, ...], color: int, kind: str) -> None:
    rng = np.random.default_rng(5)
    shape = (100, 120) if kind == "mono" else (100, 120, 3)
    images = StereoImages(
        *rng.integers(0, 4096, (2, *shape)).astype(np.uint16),
        time_s=0.0,
        exposure_s=1e-3,
        bits=12,
        encoding="gamma" if kind == "gamma" else "linear",
        black_level_dn=64.0,
        left_mosaic=rng.integers(0, 4096, (100, 120)).astype(np.uint16) if kind == "mosaic" else None,
    )
    left, top, right, bottom = window
    whole = marker_channel(images, "left", color, 1.4)
    part = marker_channel(images, "left", color, 1.4, window)
    assert part.shape == (bottom - top, right - left)
    assert (part == whole[top:bottom, left:right]).all()
    assert whole.any()


@pytest.mark.parametrize("turn", range(8))
@pytest.mark.parametrize("color", [0, 2])
def test_the_edge_of_a_bright_sky_leads_nowhere_in_a_mosaic(color: int, turn: int) -> None:
    v, u = np.mgrid[:60, :80].astype(np.float64)
    away_px = (u - 40) * np.cos(turn * np.pi / 4) + (v - 30) * np.sin(turn * np.pi / 4)
    mosaic = np.round(8 + 190 / (1 + np.exp(-2 * away_px))).astype(np.uint8)
    blank = np.zeros((60, 80, 3), np.uint8)
    images = StereoImages(blank, blank, 0.0, 1e-3, left_mosaic=mosaic, right_mosaic=mosaic)
    # Sites of one cell differ by up to 40 numbers there.
    assert marker_channel(images, "left", color).max() == 0


@pytest.mark.parametrize("weight", OTHERS_WEIGHTS)
@pytest.mark.parametrize("color", [0, 1, 2])
def test_a_mosaic_shows_what_its_picture_shows(color: int, weight: float) -> None:
    """Of even patches, so that the sites of a cell tell the picture's colour; black is not subtracted with the rest."""
    patches = np.random.default_rng(6).integers(0, 61, (2, 2, 3)) + 168
    patches[0, 0, color] += 500
    picture = np.kron(patches, np.ones((20, 20, 1))).astype(np.uint16)
    mosaic = picture[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = picture[0::2, 0::2, 0], picture[1::2, 1::2, 2]
    images = StereoImages(picture, picture, 0.0, 1e-3, bits=12, black_level_dn=168.0)
    raw = replace(images, left_mosaic=mosaic, right_mosaic=mosaic)
    middles = np.s_[9::20, 9::20]
    seen = marker_channel(raw, "left", color, weight)[middles]
    assert seen[0, 0] > 400
    np.testing.assert_array_equal(seen, marker_channel(images, "left", color, weight)[middles])
