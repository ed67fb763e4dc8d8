"""Pairs left and right images by their time stamps."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable
from itertools import pairwise


def match_stamps(
    left_ns: Iterable[int], right_ns: Iterable[int], tolerance_ns: int, where: str
) -> list[tuple[int, int]]:
    """The pairs of stamps that differ by no more than the tolerance, in ascending order.

    Args:
        left_ns, right_ns: stamps, each but once. [ns]
        tolerance_ns: largest difference in a pair. [ns]
        where: what they are of, for errors.

    Raises:
        ValueError: a stamp has two possible partners.
    """
    left, right = sorted(left_ns), sorted(right_ns)
    pairs: list[tuple[int, int]] = []
    for stamp in left:
        near = right[bisect_left(right, stamp - tolerance_ns) : bisect_right(right, stamp + tolerance_ns)]
        pairs += [(stamp, other) for other in near]
    for place in (0, 1):
        for first, second in pairwise(pairs):
            if first[place] == second[place]:
                raise ValueError(
                    f"{where}: the stamp {first[place]} ns has two partners within {tolerance_ns / 1e6:g} ms, "
                    f"{first[1 - place]} and {second[1 - place]} ns; make the tolerance smaller"
                )
    return pairs


def smallest_difference_ns(left_ns: Iterable[int], right_ns: Iterable[int]) -> int | None:
    """The smallest difference between a left and a right stamp, or None where one side has none. [ns]"""
    right = sorted(right_ns)
    nearest: int | None = None
    for stamp in left_ns:
        place = bisect_left(right, stamp)
        for other in right[max(place - 1, 0) : place + 1]:
            nearest = abs(stamp - other) if nearest is None else min(nearest, abs(stamp - other))
    return nearest
