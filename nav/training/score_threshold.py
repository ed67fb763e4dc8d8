"""The score from which on an answer is taken for a drogue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geometry.boxes import intersection_over_union
from nav.training.image_views import Boxes

_LEAST_OVERLAP = 0.5


def best_threshold(truth: Sequence[Boxes], found: Sequence[tuple[Boxes, Boxes]], otherwise: float) -> float:
    """A threshold for the best answers of all images, one to an image as the detector gives them.

    It is that with the fewest wrong answers and missed drogues, where an answer in an image without a drogue counts for
    more the fewer of these images there are: rates decide, not how many a dataset happens to have. As some hundred
    images do not tell which of many thresholds that is, it is the middle of all that have as few but for chance.

    Args:
        truth: of each image (n, 4) boxes, n 0 or 1.
        found: of each image (m, 4) boxes and (m,) scores, the best first.
        otherwise: where no answer is right.

    Returns:
        Midway between the highest and the lowest of those.
    """
    best = [
        (float(scores[0]), len(own) > 0, len(own) > 0 and intersection_over_union(own[0], boxes[0]) >= _LEAST_OVERLAP)
        for own, (boxes, scores) in zip(truth, found, strict=True)
        if len(scores)
    ]
    best.sort(key=lambda answer: -answer[0])
    right = np.cumsum([is_right for _, _, is_right in best])
    if not len(right) or right[-1] == 0:
        return otherwise
    shown = sum(len(own) > 0 for own in truth)
    # A missed drogue costs as much as a wrong box beside one.
    weight = shown / max(len(truth) - shown, 1)
    false = np.cumsum([(1.0 if shows else weight) * (not is_right) for _, shows, is_right in best])
    wrong = (shown - right) + false
    # The number of rare events scatters by its root.
    good = np.flatnonzero(wrong < max(wrong.min() + np.sqrt(wrong.min()), wrong.min() + 0.5))
    first, last = int(good[0]), int(good[-1])
    below = best[last + 1][0] if last + 1 < len(best) else 0.0
    return (best[first][0] + below) / 2
