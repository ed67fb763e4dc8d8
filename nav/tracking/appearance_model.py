"""Appearance of the drogue in its box: a correlation that checks a box, and a template that aligns one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.tracking.region import Box, EyeImage, ImageRegion, box_around, box_center, box_size, grown, image_region

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


Array32 = NDArray[np.float32]

# Pixels of the template along each side, and how many box sides they cover: the rim's outer edge lies inside.
_TEMPLATE_SIDE = 32
_COVERED = 1.16
# Only a disc counts: the corners are background.
_TEMPLATE_REACH = 0.57
_ALIGNMENT_STEPS = 8
# Pixels of the template's grid, a hundredth of which is of no use.
_SETTLED = 0.01
# A pixel that differs by more than so many typical differences counts as that: something else stands there.
_OUTLIER = 2.5
_LEAST_PIXELS_FRACTION = 0.3
# As slowly as the chances of the tests; what is laid on it follows a change of light, and hardly drifts.
_FORGETTING = 0.98


class Template:
    """What the drogue in a box looked like, averaged over the pairs so far."""

    def __init__(self, region: ImageRegion, box: Box) -> None:
        axis = ((np.arange(_TEMPLATE_SIDE) + 0.5) / _TEMPLATE_SIDE - 0.5) * _COVERED
        self._x, self._y = np.meshgrid(axis.astype(np.float32), axis.astype(np.float32))
        self._disc = np.hypot(self._x, self._y) < _TEMPLATE_REACH
        self._look = self._sample(region, box)[0]

    def align(self, region: ImageRegion, box: Box) -> Box:
        """The box moved and scaled so that its content is the template's, up to gain and offset of light.

        Gauss-Newton over middle and log-scale with clipped residuals (inverse compositional form: Baker and Matthews,
        doi:10.1023/B:VISI.0000011205.11775.fd).
        """
        look = self._look[self._disc]
        design = self._design()
        center, log_scale, start = box_center(box), 0.0, box
        for _ in range(_ALIGNMENT_STEPS):
            seen, valid = self._sample(region, box)
            weights = np.repeat(valid[self._disc], look.shape[1]).astype(np.float32)
            if weights.mean() < _LEAST_PIXELS_FRACTION:
                break
            step = _least_squares(design, (seen[self._disc] - look).ravel(), weights)
            # The template's step onto the image is undone: moving the look by p is moving the box by -p.
            center = center - step[:2] * box[2:]
            log_scale -= float(step[2])
            scale = float(np.exp(log_scale))
            box = box_around(center, start[2] * scale, start[3] * scale)
            if np.abs(step).max() * _TEMPLATE_SIDE / _COVERED < _SETTLED:
                break
        return box

    def learn(self, region: ImageRegion, box: Box) -> None:
        """Let what a box shows count a little, brought to the light of the template."""
        seen, on_image = self._sample(region, box)
        valid = self._disc & on_image
        new, old = seen[valid], self._look[valid]
        spread = float(np.var(new)) if new.size else 0.0
        if spread == 0:
            return
        gain = float(np.mean((new - new.mean()) * (old - old.mean()))) / spread
        brought = old.mean() + np.float32(gain) * (new - new.mean())
        self._look[valid] += np.float32(1 - _FORGETTING) * (brought - old)

    def _sample(self, region: ImageRegion, box: Box) -> tuple[Array32, NDArray[np.bool_]]:
        """(side, side, C) what a box shows, and (side, side) which of that lies on the image."""
        center = region.grid(box_center(box))
        step = np.array(box[2:]) / region.step_px * _COVERED / _TEMPLATE_SIDE
        first = center - step * (_TEMPLATE_SIDE - 1) / 2
        there = np.array([[step[0], 0, first[0]], [0, step[1], first[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpAffine(
            region.pixels, there, (_TEMPLATE_SIDE, _TEMPLATE_SIDE), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        x, y = (first[axis] + step[axis] * np.arange(_TEMPLATE_SIDE) for axis in (0, 1))
        on_x, on_y = ((each >= -0.5) & (each <= size - 0.5) for each, size in zip((x, y), region.size, strict=True))
        seen32: Array32 = np.asarray(seen).reshape(_TEMPLATE_SIDE, _TEMPLATE_SIDE, -1).astype(np.float32)
        return seen32, on_y[:, None] & on_x

    def _design(self) -> Array32:
        """(M, 5) change of the look in the disc with moves in x and y, with log-scale, gain and offset; box sides."""
        per_side = _TEMPLATE_SIDE / _COVERED
        by_y, by_x = (np.gradient(self._look, axis=axis) * np.float32(per_side) for axis in (0, 1))
        by_scale = by_x * self._x[..., None] + by_y * self._y[..., None]
        columns = [column[self._disc].ravel() for column in (by_x, by_y, by_scale, self._look)]
        return np.stack([*columns, np.ones_like(columns[0])], axis=1)


def _least_squares(design: Array32, difference: Array32, weights: Array32) -> Array:
    """(3,) the move of the look that explains a difference (M,) best, with gain and offset of light left free."""
    there = difference[weights > 0]
    middle = np.median(there)
    typical = np.float32(1.4826 * np.median(np.abs(there - middle)) + 1.0)
    weights = weights * np.minimum(1, _OUTLIER * typical / np.maximum(np.abs(difference - middle), np.float32(1e-3)))
    weighted = (design * weights[:, None]).T
    # Where the look is flat along a direction nothing can be said of it: no step.
    normal, right = (weighted @ design).astype(np.float64), (weighted @ difference).astype(np.float64)
    solution = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    step: Array = np.clip(solution[:3], -0.1, 0.1)
    return step
