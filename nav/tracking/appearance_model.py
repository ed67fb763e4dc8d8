"""Whether a box still shows what it showed: a correlation for trackers that cannot tell by themselves."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nav.tracking.region import Box, EyeImage, box_size, grown, image_region

_SIDE = 32
# The corners of a drogue's box are background.
_AXIS = (np.arange(_SIDE) + 0.5) / _SIDE - 0.5
_DISC = np.hypot(_AXIS[:, None], _AXIS) <= 0.5
# What is taken from the newest look, so that a slow change of light is followed.
_NEW_SHARE = 0.05
# Below so much of the first contrast there is nothing but noise in the box.
_LEAST_CONTRAST = 0.15
# Less of the box than this on the image says nothing of the rest.
_LEAST_SEEN_FRACTION = 0.4
ALIKE = 0.5
"""Correlation below which a box shows something else."""


class Likeness:
    """The look of a box, without gain and offset of light."""

    def __init__(self, image: EyeImage, box: Box) -> None:
        patch, seen = _patch(image, box)
        self._contrast = float(patch[seen].std()) if seen.any() else 0.0
        self._look = patch - patch.mean()

    def of(self, image: EyeImage, box: Box) -> float:
        """Correlation of what a box shows with the look so far, from -1 to 1."""
        patch, seen = _patch(image, box)
        if seen.sum() < _LEAST_SEEN_FRACTION * _DISC.sum():
            return -1.0
        now, look = patch[seen] - patch[seen].mean(), self._look[seen] - self._look[seen].mean()
        power = float(np.sqrt((now**2).sum() * (look**2).sum()))
        if now.std() < _LEAST_CONTRAST * self._contrast or power == 0:
            return 0.0
        return float((now * look).sum()) / power

    def learn(self, image: EyeImage, box: Box) -> None:
        """Let what a box shows count a little, brought to the contrast of the look so far."""
        patch, seen = _patch(image, box)
        if not seen.any():
            return
        now, look = patch[seen] - patch[seen].mean(), self._look[seen] - self._look[seen].mean()
        if now.std() > 0:
            self._look[seen] += np.float32(_NEW_SHARE) * (np.float32(look.std() / now.std()) * now - look)


def _patch(image: EyeImage, box: Box) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(side, side) grey of a box, and which of that counts: the disc in it, on the image."""
    region = image_region(image, grown(box, 2, 2), max(box_size(box) / _SIDE, 0.5))
    if region is None:
        return np.zeros((_SIDE, _SIDE), np.float32), np.zeros((_SIDE, _SIDE), bool)
    x, y = (box[axis] + (np.arange(_SIDE) + 0.5) / _SIDE * box[2 + axis] for axis in (0, 1))
    columns = (x - region.origin_px[0]) / region.step_px[0]
    rows = (y - region.origin_px[1]) / region.step_px[1]
    map_x, map_y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    patch = cv2.remap(region.grey(), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    on_x, on_y = (
        (each >= -0.5) & (each <= size - 0.5) for each, size in zip((columns, rows), region.size, strict=True)
    )
    return np.asarray(patch).astype(np.float32), _DISC & on_y[:, None] & on_x
