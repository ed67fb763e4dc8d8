"""Shared area and intersection over union of boxes."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.boxes import intersection_area, intersection_over_union


@pytest.mark.parametrize(
    ("other", "want"),
    [
        ((0.0, 0.0, 4.0, 2.0), 1.0),
        ((2.0, 0.0, 4.0, 2.0), 1 / 3),
        ((4.0, 0.0, 4.0, 2.0), 0.0),
        ((1.0, 0.5, 2.0, 1.0), 1 / 4),
        ((9.0, 9.0, 0.0, 0.0), 0.0),
    ],
)
def test_what_two_boxes_share(other: tuple[float, ...], want: float) -> None:
    assert intersection_over_union((0.0, 0.0, 4.0, 2.0), other) == pytest.approx(want)
    assert intersection_over_union(other, (0.0, 0.0, 4.0, 2.0)) == pytest.approx(want)


def test_boxes_broadcast_and_missing_ones_share_nothing() -> None:
    boxes = np.array([[0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 2.0, 2.0], [np.nan] * 4])
    np.testing.assert_array_equal(intersection_area(boxes[0], boxes[:2]), [4.0, 1.0])
    np.testing.assert_array_equal(intersection_over_union(boxes[0], boxes), [1.0, 1 / 7, 0.0])


def test_equal_boxes_share_no_more_than_all() -> None:
    boxes = np.random.default_rng(5).uniform(0.1, 1000.0, (2000, 4))
    assert intersection_over_union(boxes, boxes).max() <= 1.0
