"""What an importer reads: stereo pairs, one at a time, and what had to be left out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from datasets_manifest.types.images import Pixels


@dataclass(frozen=True, eq=False)
class SourcePair:
    """One stereo pair of somebody's camera.

    Attributes:
        names: of the left and the right image where it came from.
        time_s: mid-exposure, or what its source has for it. [s]
        left, right: (H, W, 3) red, green, blue, or (H, W) grey.
    """

    names: tuple[str, str]
    time_s: float
    left: Pixels
    right: Pixels


class PairSource(Protocol):
    """Stereo pairs in the order of time.

    Attributes:
        count: how many there are.
        left_out: what has no partner or is nothing to import, and why.
    """

    count: int
    left_out: tuple[str, ...]

    def __iter__(self) -> Iterator[SourcePair]:
        """The pairs, each read when it is asked for.

        Raises:
            ValueError: one that cannot be read; names it.
        """
        ...
