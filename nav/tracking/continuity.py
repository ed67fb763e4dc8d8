"""What whoever follows the drogue through pairs goes by: where a sequence begins, when to ask the detector again."""

from __future__ import annotations

from geometry.boxes import intersection_over_union

PixelBox = tuple[float, float, float, float]

# A longer time between two pairs parts two sequences. [s]
_LONGEST_GAP_S = 1.0
REDETECT_EVERY = 25
"""The detector checks a tracker after so many pairs without it: a second at the seed paper's 25 pairs a second."""
# Boxes that overlap by less show different things.
_SAME_PLACE = 0.5


def begins_sequence(last_s: float | None, now_s: float) -> bool:
    """Whether a pair is the first of a sequence: its time stamp does not follow the last one's, or only after a gap.

    Args:
        last_s: time of the pair before; None where there is none. [s]
        now_s: time of the pair. [s]
    """
    return last_s is None or not 0 < now_s - last_s <= _LONGEST_GAP_S


def is_same_place(one: PixelBox, other: PixelBox) -> bool:
    """Whether two boxes of one image show the same thing."""
    return bool(intersection_over_union(one, other) >= _SAME_PLACE)
