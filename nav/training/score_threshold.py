"""The score from which on an answer is taken for a drogue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nav.training.image_views import Boxes

_LEAST_OVERLAP = 0.5


def best_threshold(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]], otherwise: float) -> float:
    """The threshold with the best F1 of the best answers of all images, one to an image as the detector gives them.

    Args:
        truth: of each image (n, 4) boxes, n 0 or 1.
        found: of each image (m, 4) boxes and (m,) scores, the best first.
        otherwise: where no answer is right.

    Returns:
        A score midway between those that it keeps and leaves out.
    """
    best = [
        (float(scores[0]), len(own) > 0 and _overlap(own[0], boxes[0]) >= _LEAST_OVERLAP)
        for own, (boxes, scores) in zip(truth, found, strict=True)
        if len(scores)
    ]
    best.sort(key=lambda answer: -answer[0])
    right = np.cumsum([is_right for _, is_right in best])
    if not len(right) or right[-1] == 0:
        return otherwise
    f1 = 2 * right / (np.arange(1, len(best) + 1) + sum(len(own) > 0 for own in truth))
    # The last of equally good ones: what more it lets through is half right.
    last = int(len(f1) - 1 - np.argmax(f1[::-1]))
    below = best[last + 1][0] if last + 1 < len(best) else 0.0
    return (best[last][0] + below) / 2


def _overlap(first: Boxes, second: Boxes) -> float:
    """Intersection over union of two boxes."""
    low, high = np.maximum(first[:2], second[:2]), np.minimum(first[:2] + first[2:], second[:2] + second[2:])
    shared = float(np.prod(np.maximum(high - low, 0)))
    return shared / float(first[2] * first[3] + second[2] * second[3] - shared)
