from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from nav.matching.connected_regions import connected_regions


def sorted_regions(boxes: NDArray[np.int64], areas: NDArray[np.int64], centers: NDArray[np.float64]) -> list[tuple]:
    return sorted(
        (*box, area, *center)
        for box, area, center in zip(boxes.tolist(), areas.tolist(), centers.tolist(), strict=True)
    )


def check_against_opencv(mask: NDArray[np.uint8]) -> None:
    _, _, stats, centers = cv2.connectedComponentsWithStats(mask, connectivity=8)
    ours = connected_regions(mask)
    assert sorted_regions(ours.boxes, ours.areas_px2, ours.centers_px) == sorted_regions(
        stats[1:, :4], stats[1:, 4], centers[1:]
    )


@given(
    st.integers(1, 30),
    st.integers(1, 70),
    st.floats(0, 1),
    st.integers(1, 9),
    st.sampled_from([1, 255]),
    st.integers(0),
)
def test_regions_are_those_of_opencv(height: int, width: int, share: float, grain: int, one: int, seed: int) -> None:
    # Grains wider than a pixel give long runs and concave regions.
    noise = np.random.default_rng(seed).random((-(-height // grain), -(-width // grain)))
    mask = np.kron(noise < share, np.ones((grain, grain)))[:height, :width].astype(np.uint8) * np.uint8(one)
    check_against_opencv(mask)


@pytest.mark.parametrize("width", [7, 8, 9, 16, 61, 64])
@pytest.mark.parametrize("value", [0, 1])
def test_even_masks_and_runs_that_end_with_the_row(width: int, value: int) -> None:
    check_against_opencv(np.full((5, width), value, np.uint8))
    ends = np.zeros((6, width), np.uint8)
    ends[::2, -1], ends[1::2, 0] = 1, 1  # behind each other in memory, but not neighbours
    check_against_opencv(ends)


def test_a_part_of_a_mask_and_a_spiral() -> None:
    whole = (np.random.default_rng(3).random((40, 50)) < 0.4).astype(np.uint8)
    check_against_opencv(whole[3:30, 5:41])
    check_against_opencv(np.ascontiguousarray(whole[:, :47])[1:])  # begins between two words of memory
    spiral = np.zeros((41, 41), np.uint8)
    left, right, top, bottom = 0, 40, 0, 40
    while left < right:
        spiral[top, left : right + 1], spiral[top : bottom + 1, right] = 1, 1
        spiral[bottom, left + 2 : right + 1], spiral[top + 4 : bottom + 1, left + 2] = 1, 1
        left, right, top, bottom = left + 2, right - 4, top + 4, bottom - 4
    check_against_opencv(spiral)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_a_mask_without_pixels_has_no_regions(shape: tuple[int, int]) -> None:
    regions = connected_regions(np.zeros(shape, np.uint8))
    assert regions.boxes.shape == (0, 4) and regions.centers_px.shape == (0, 2)


def test_regions_come_row_by_row() -> None:
    mask = np.zeros((4, 12), np.uint8)
    mask[0, 9] = mask[1, 1] = mask[3, 5] = 1
    assert connected_regions(mask).centers_px.tolist() == [[9, 0], [1, 1], [5, 3]]
