"""Overlaps against pycocotools, and the plots in cases with a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from pycocotools import mask

from droguekit.scoring.sequences.tracking_scores import (
    CENTER_ERRORS_PX,
    NO_BOX,
    NORMALIZED_ERRORS,
    center_errors_px,
    normalized_center_errors,
    precision_curve,
    success_curve,
)
from geometry.boxes import intersection_over_union


def random_boxes(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(0, 300, (count, 2)), rng.uniform(5, 200, (count, 2))])


def test_overlaps_are_those_of_pycocotools(rng: np.random.Generator) -> None:
    found, truth = random_boxes(rng, 200), random_boxes(rng, 200)
    expected = [mask.iou([a], [b], [0])[0, 0] for a, b in zip(found.tolist(), truth.tolist(), strict=True)]
    assert np.count_nonzero(expected) > 50
    # Rounding.
    np.testing.assert_allclose(intersection_over_union(found, truth), expected, atol=1e-12)


def test_a_missing_box_overlaps_nothing_and_is_nowhere() -> None:
    truth = np.array([[10.0, 10, 20, 20]])
    found = np.array([NO_BOX])
    assert intersection_over_union(found, truth).tolist() == [0.0]
    assert center_errors_px(found, truth).tolist() == [np.inf]
    assert precision_curve(center_errors_px(found, truth), CENTER_ERRORS_PX).max() == 0


def test_a_perfect_tracker_has_all_but_the_last_threshold() -> None:
    """No overlap is above 1: the area under OTB's success plot ends at 20/21."""
    truth = np.array([[10.0, 10, 20, 20]] * 4)
    success = success_curve(intersection_over_union(truth, truth))
    assert success.tolist() == [1.0] * 20 + [0.0]
    assert success.mean() == pytest.approx(20 / 21)
    assert precision_curve(center_errors_px(truth, truth), CENTER_ERRORS_PX).min() == 1


def test_a_shifted_box_falls_where_its_overlap_says() -> None:
    """Half a width aside: intersection over union is one third, the centre half a width off."""
    truth = np.array([[0.0, 0, 40, 10]] * 3)
    found = truth + np.array([20.0, 0, 0, 0])
    assert intersection_over_union(found, truth) == pytest.approx(1 / 3)
    assert success_curve(intersection_over_union(found, truth)).sum() == pytest.approx(
        7
    )  # 0, 0.05, ... 0.3 lie below a third
    errors = center_errors_px(found, truth)
    assert precision_curve(errors, CENTER_ERRORS_PX).argmax() == 20
    assert normalized_center_errors(found, truth) == pytest.approx(0.5)


def test_normalised_errors_do_not_depend_on_the_size(rng: np.random.Generator) -> None:
    found, truth = random_boxes(rng, 50), random_boxes(rng, 50)
    once, larger = normalized_center_errors(found, truth), normalized_center_errors(7 * found, 7 * truth)
    np.testing.assert_allclose(once, larger, rtol=1e-12)
    assert NORMALIZED_ERRORS[-1] == 0.5
