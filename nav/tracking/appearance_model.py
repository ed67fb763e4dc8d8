"""Appearance of the drogue in its box: a correlation that checks a box, and a template that aligns one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.tracking.region import (
    Box,
    EyeImage,
    ImageRegion,
    box_center,
    box_from_center,
    box_size,
    expand_box,
    image_region,
)

_SIDE = 32
# The corners of a drogue's box are background.
_PIXELS = (np.arange(_SIDE) + 0.5) / _SIDE - 0.5
_DISC = np.hypot(_PIXELS[:, None], _PIXELS) <= 0.5
# Weight of the newest image, so that slow changes of light are followed.
_LEARNING_RATE = 0.05
# Below this share of the first contrast there is only noise in the box.
_LEAST_CONTRAST = 0.15
# Smaller share of the box on the image is not compared.
_LEAST_SEEN_FRACTION = 0.4
LEAST_CORRELATION = 0.5
"""Correlation below which a box shows something else."""


class AppearanceModel:
    """Average grey image of a box; comparisons ignore gain and offset of light."""

    def __init__(self, image: EyeImage, box: Box) -> None:
        patch, seen = _patch(image, box)
        self._contrast = float(patch[seen].std()) if seen.any() else 0.0
        self._average = patch - patch.mean()

    def correlation(self, image: EyeImage, box: Box) -> float:
        """Normalised correlation of a box with the average so far, from -1 to 1."""
        patch, seen = _patch(image, box)
        if seen.sum() < _LEAST_SEEN_FRACTION * _DISC.sum():
            return -1.0
        centred, average = patch[seen] - patch[seen].mean(), self._average[seen] - self._average[seen].mean()
        norms = float(np.sqrt((centred**2).sum() * (average**2).sum()))
        if centred.std() < _LEAST_CONTRAST * self._contrast or norms == 0:
            return 0.0
        return float((centred * average).sum()) / norms

    def learn(self, image: EyeImage, box: Box) -> None:
        """Update the average by a box, scaled to the contrast of the average."""
        patch, seen = _patch(image, box)
        if not seen.any():
            return
        centred, average = patch[seen] - patch[seen].mean(), self._average[seen] - self._average[seen].mean()
        if centred.std() > 0:
            self._average[seen] += np.float32(_LEARNING_RATE) * (
                np.float32(average.std() / centred.std()) * centred - average
            )


def _patch(image: EyeImage, box: Box) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(side, side) grey pixels of a box, and which of them count: those in its inscribed disc and on the image."""
    region = image_region(image, expand_box(box, 2, 2), max(box_size(box) / _SIDE, 0.5))
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

# Pixels of the template along each side, and its size in box sides: the rim's outer edge lies inside.
_TEMPLATE_SIDE = 32
_TEMPLATE_SIZE = 1.16
# Only a disc of this radius counts, in box sides: the corners are background.
_TEMPLATE_REACH = 0.57
_ALIGNMENT_STEPS = 8
# Steps below this many template pixels end the alignment.
_CONVERGED = 0.01
# Differences beyond this many typical ones are clipped: something else stands there.
_OUTLIER_FACTOR = 2.5
_LEAST_PIXELS_FRACTION = 0.3
# As slow as the pass rates of the pixel comparisons; follows changes of light, and hardly drifts.
_FORGETTING = 0.98


class AlignmentTemplate:
    """Average image of the drogue in its box over the pairs so far, to which boxes are aligned."""

    def __init__(self, region: ImageRegion, box: Box) -> None:
        axis = ((np.arange(_TEMPLATE_SIDE) + 0.5) / _TEMPLATE_SIDE - 0.5) * _TEMPLATE_SIZE
        self._x, self._y = np.meshgrid(axis.astype(np.float32), axis.astype(np.float32))
        self._disc = np.hypot(self._x, self._y) < _TEMPLATE_REACH
        self._average = self._sample(region, box)[0]

    def align(self, region: ImageRegion, box: Box) -> Box:
        """The box, shifted and scaled so that its content matches the template up to gain and offset of light.

        Gauss-Newton over centre and log-scale with clipped residuals (inverse compositional form: Baker and Matthews,
        doi:10.1023/B:VISI.0000011205.11775.fd).
        """
        average = self._average[self._disc]
        design = self._design()
        center, log_scale, start = box_center(box), 0.0, box
        for _ in range(_ALIGNMENT_STEPS):
            seen, valid = self._sample(region, box)
            weights = np.repeat(valid[self._disc], average.shape[1]).astype(np.float32)
            if weights.mean() < _LEAST_PIXELS_FRACTION:
                break
            step = _least_squares(design, (seen[self._disc] - average).ravel(), weights)
            # Inverse compositional: moving the template by p is moving the box by -p.
            center = center - step[:2] * box[2:]
            log_scale -= float(step[2])
            scale = float(np.exp(log_scale))
            box = box_from_center(center, start[2] * scale, start[3] * scale)
            if np.abs(step).max() * _TEMPLATE_SIDE / _TEMPLATE_SIZE < _CONVERGED:
                break
        return box

    def learn(self, region: ImageRegion, box: Box) -> None:
        """Update the template by a box, matched to the template's gain and offset of light."""
        seen, on_image = self._sample(region, box)
        valid = self._disc & on_image
        new, old = seen[valid], self._average[valid]
        spread = float(np.var(new)) if new.size else 0.0
        if spread == 0:
            return
        gain = float(np.mean((new - new.mean()) * (old - old.mean()))) / spread
        matched = old.mean() + np.float32(gain) * (new - new.mean())
        self._average[valid] += np.float32(1 - _FORGETTING) * (matched - old)

    def _sample(self, region: ImageRegion, box: Box) -> tuple[Array32, NDArray[np.bool_]]:
        """(side, side, C) pixels of a box, and (side, side) which of them lie on the image."""
        center = region.to_grid(box_center(box))
        step = np.array(box[2:]) / region.step_px * _TEMPLATE_SIZE / _TEMPLATE_SIDE
        first = center - step * (_TEMPLATE_SIDE - 1) / 2
        region_from_template = np.array([[step[0], 0, first[0]], [0, step[1], first[1]]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpAffine(
            region.pixels,
            region_from_template,
            (_TEMPLATE_SIDE, _TEMPLATE_SIDE),
            flags=flags,
            borderMode=cv2.BORDER_REPLICATE,
        )
        x, y = (first[axis] + step[axis] * np.arange(_TEMPLATE_SIDE) for axis in (0, 1))
        on_x, on_y = ((each >= -0.5) & (each <= size - 0.5) for each, size in zip((x, y), region.size, strict=True))
        seen32: Array32 = np.asarray(seen).reshape(_TEMPLATE_SIDE, _TEMPLATE_SIDE, -1).astype(np.float32)
        return seen32, on_y[:, None] & on_x

    def _design(self) -> Array32:
        """(M, 5) derivative of the template in the disc by x, y [box sides], log-scale, gain and offset."""
        per_side = _TEMPLATE_SIDE / _TEMPLATE_SIZE
        by_y, by_x = (np.gradient(self._average, axis=axis) * np.float32(per_side) for axis in (0, 1))
        by_scale = by_x * self._x[..., None] + by_y * self._y[..., None]
        columns = [column[self._disc].ravel() for column in (by_x, by_y, by_scale, self._average)]
        return np.stack([*columns, np.ones_like(columns[0])], axis=1)


def _least_squares(design: Array32, difference: Array32, weights: Array32) -> Array:
    """(3,) shift and log-scale of the template that fit a difference (M,) best, with free gain and offset of light."""
    used = difference[weights > 0]
    middle = np.median(used)
    typical = np.float32(1.4826 * np.median(np.abs(used - middle)) + 1.0)
    weights = weights * np.minimum(
        1, _OUTLIER_FACTOR * typical / np.maximum(np.abs(difference - middle), np.float32(1e-3))
    )
    weighted = (design * weights[:, None]).T
    # A direction without gradient gets no step.
    normal, right = (weighted @ design).astype(np.float64), (weighted @ difference).astype(np.float64)
    solution = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
    step: Array = np.clip(solution[:3], -0.1, 0.1)
    return step
