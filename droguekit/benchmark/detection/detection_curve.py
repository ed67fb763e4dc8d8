"""Precision and recall against the score from which a box counts, at overlap 0.5."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from droguekit.benchmark.detection.detection_matching import AT_50, Matches
from geometry.se3 import Array


class OperatingPoint(NamedTuple):
    """What a detector does when boxes of at least a score count.

    Attributes:
        threshold: the score.
        precision: share of the boxes that are drogues; None without boxes.
        recall: share of the drogues that were found; None without drogues.
        f1: harmonic mean of the two, 0 where nothing is right; None where recall is.
    """

    threshold: float
    precision: float | None
    recall: float | None
    f1: float | None


class PrecisionRecallCurve(NamedTuple):
    """A point for every score that was given, highest first.

    Attributes:
        threshold, precision, recall: (m,) of boxes with at least that score.
    """

    threshold: Array
    precision: Array
    recall: Array


def precision_recall(matches: Matches) -> PrecisionRecallCurve:
    """The curve of all boxes; empty without boxes or without drogues."""
    if not matches.drogues:
        return PrecisionRecallCurve(np.zeros(0), np.zeros(0), np.zeros(0))
    threshold, boxes, true = _passing(matches)
    return PrecisionRecallCurve(threshold, true / boxes, true / matches.drogues)


def best_f1(matches: Matches) -> OperatingPoint | None:
    """The threshold with the highest F1, midway to the next lower score or to 0; None where no box is right.

    Of equally good ones it is the lowest: what more it lets through is half right. A training chooses the threshold of
    its network by the same rule, of the best box of each image.
    """
    threshold, boxes, true = _passing(matches)
    if not true.any():
        return None
    f1 = 2 * true / (boxes + matches.drogues)
    best = int(len(f1) - 1 - np.argmax(f1[::-1]))
    # Files of others may have scores below 0.
    below = float(threshold[best + 1]) if best + 1 < len(f1) else min(0.0, float(threshold[best]))
    return operating_point(matches, (float(threshold[best]) + below) / 2)


def operating_point(matches: Matches, threshold: float) -> OperatingPoint:
    """Precision and recall where boxes of at least `threshold` count."""
    passes = matches.score >= threshold
    true = int(matches.is_true[AT_50][passes].sum())
    boxes = int(passes.sum())
    precision = true / boxes if boxes else None
    if not matches.drogues:
        return OperatingPoint(threshold, precision, None, None)
    recall = true / matches.drogues
    f1 = 2 * true / (boxes + matches.drogues)
    return OperatingPoint(threshold, precision, recall, f1)


def _passing(matches: Matches) -> tuple[Array, Array, Array]:
    """(m,) scores, highest first, and how many boxes have at least each of them, all and right ones."""
    # Boxes of equal score pass a threshold together.
    last = np.flatnonzero(np.append(np.diff(matches.score) != 0, True)[: len(matches.score)])
    return matches.score[last], last + 1.0, np.cumsum(matches.is_true[AT_50])[last].astype(np.float64)
