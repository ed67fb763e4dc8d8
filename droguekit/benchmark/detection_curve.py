"""Precision and recall against the score from which a box counts, at overlap 0.5."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from droguekit.benchmark.detection_matching import AT_50, RECALLS, Matches
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
    count = len(matches.score)
    if not count or not matches.drogues:
        return PrecisionRecallCurve(np.zeros(0), np.zeros(0), np.zeros(0))
    # Boxes of equal score pass a threshold together.
    last = np.flatnonzero(np.append(np.diff(matches.score) != 0, True))
    true = np.cumsum(matches.is_true[AT_50])[last]
    return PrecisionRecallCurve(matches.score[last], true / (last + 1), true / matches.drogues)


def best_f1(matches: Matches) -> OperatingPoint | None:
    """The threshold with the highest F1, the highest among equals; None where no box is right."""
    curve = precision_recall(matches)
    if not curve.recall.any():
        return None
    total = curve.precision + curve.recall
    f1 = np.where(total > 0, 2 * curve.precision * curve.recall / np.where(total > 0, total, 1), 0.0)
    best = int(np.argmax(f1))
    return operating_point(matches, float(curve.threshold[best]))


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


def interpolated_precision(curve: PrecisionRecallCurve) -> Array:
    """(101,) the highest precision at each of COCO's recalls or more; 0 where that recall is not reached."""
    precision = np.zeros(len(RECALLS))
    if len(curve.recall):
        envelope = np.maximum.accumulate(curve.precision[::-1])[::-1]
        place = np.searchsorted(curve.recall, RECALLS, side="left")
        reached = place < len(envelope)
        precision[reached] = envelope[place[reached]]
    return precision
