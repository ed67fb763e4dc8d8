from __future__ import annotations

from math import exp

import numpy as np
import pytest

from nav.detector.output_maps import STRIDES, decode_maps

HEIGHT, WIDTH = 64, 96


def random_maps(seed: int, images: int = 2) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [
        rng.normal(size=(images, 5, HEIGHT // stride, WIDTH // stride)).astype(np.float32) * 1.5 for stride in STRIDES
    ]


def iou(a: list[float], b: list[float]) -> float:
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / (a[2] * a[3] + b[2] * b[3] - shared)


def decode_slowly(maps: list[np.ndarray], image: int, least_score: float, most: int) -> list[tuple[float, list[float]]]:
    """Cell by cell, box by box."""
    boxes = []
    for stride, each in zip(STRIDES, maps, strict=True):
        for row in range(each.shape[2]):
            for column in range(each.shape[3]):
                logit, *logs = (float(value) for value in each[image, :, row, column])
                score = 1 / (1 + exp(-logit))
                if score >= least_score:
                    left, top, right, bottom = (stride * exp(value) for value in logs)
                    u, v = stride * (column + 0.5), stride * (row + 0.5)
                    boxes.append((score, [u - left, v - top, left + right, top + bottom]))
    kept: list[tuple[float, list[float]]] = []
    for score, box in sorted(boxes, reverse=True):
        if len(kept) < most and all(iou(box, other) <= 0.5 for _, other in kept):
            kept.append((score, box))
    return kept


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("least_score", "most"), [(0.01, 20), (0.8, 20), (0.3, 3)])
def test_agrees_with_a_slow_reference(seed: int, least_score: float, most: int) -> None:
    maps = random_maps(seed)
    for image, (boxes, scores) in enumerate(decode_maps(maps, least_score, most)):
        expected = decode_slowly(maps, image, least_score, most)
        # float64 of the same float32 numbers.
        np.testing.assert_allclose(scores, [score for score, _ in expected], rtol=1e-9)
        np.testing.assert_allclose(boxes, np.reshape([box for _, box in expected], (-1, 4)), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_boxes_are_sorted_apart_and_above_the_least_score(seed: int) -> None:
    for boxes, scores in decode_maps(random_maps(seed), 0.2):
        assert len(boxes) <= 20
        assert (np.diff(scores) <= 0).all()
        assert (scores >= 0.2).all() and (scores <= 1).all()
        assert (boxes[:, 2:] > 0).all()
        for index, box in enumerate(boxes):
            assert all(iou(list(box), list(other)) <= 0.5 for other in boxes[:index])


def test_nothing_scores_enough() -> None:
    for boxes, scores in decode_maps([each * 0 - 20 for each in random_maps(0)], 0.01):
        assert boxes.shape == (0, 4) and scores.shape == (0,)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_values_that_are_not_finite_never_become_boxes(value: float) -> None:
    maps = random_maps(1)
    for each in maps:
        each[:, :, ::2] = value
    for boxes, scores in decode_maps(maps, 0.01):
        assert np.isfinite(boxes).all() and np.isfinite(scores).all()


def test_many_good_cells_are_decoded() -> None:
    maps = random_maps(2, images=1)
    for each in maps:
        each[:, 0] = 9.0
    ((boxes, scores),) = decode_maps(maps, 0.5)
    assert 1 <= len(boxes) <= 20 and (scores > 0.99).all()
