"""The pixels of one eye, sorted by the feature that they see."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from drogue_models.parts import FIRST_MARKER_ID, MAX_MARKERS, Part

Indices = NDArray[np.int64]

_FEATURES = (int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + MAX_MARKERS))


def is_one_of(part_id: NDArray[np.uint8], parts: tuple[int, ...] | list[int]) -> NDArray[np.bool_]:
    """(H, W) whether a pixel centre sees one of some parts."""
    table = np.zeros(256, dtype=np.uint8)
    table[list(parts)] = 1
    mask: NDArray[np.bool_] = cv2.LUT(part_id, table).view(np.bool_)
    return mask


class FeaturePixels:
    """Where one eye sees markers and hub; they are found in one pass over the image."""

    def __init__(self, part_id: NDArray[np.uint8]) -> None:
        found = cv2.findNonZero(is_one_of(part_id, _FEATURES).view(np.uint8))
        places = np.zeros((0, 2), dtype=np.int64) if found is None else found[:, 0].astype(np.int64)
        parts = part_id[places[:, 1], places[:, 0]]
        order = np.argsort(parts, kind="stable")
        self._places = places[order]
        self._ends = np.searchsorted(parts[order], np.arange(257))

    def count(self, part: int) -> int:
        """How many pixel centres see a feature."""
        return int(self._ends[part + 1] - self._ends[part])

    def places(self, part: int) -> tuple[Indices, Indices]:
        """Rows and columns of the pixel centres that see a feature, in the order of the image."""
        places = self._places[self._ends[part] : self._ends[part + 1]]
        return places[:, 1], places[:, 0]
