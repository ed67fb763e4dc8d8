"""Numbers that tell a photograph from a plain render: noise, its correlation, levels, sharpness and blocks."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_PATCH_PX = 16
# The calmest patches of a picture show its noise.
_CALM_SHARE = 0.05
_DARK_LEVEL, _BRIGHT_LEVEL = 16, 250
_BLOCK_PX = 8
# Edges of which sharpness is told: among the steepest of the picture, and of more than so many levels.
_EDGES, _LEAST_STEP = 400, 40
_REACH_PX = 12


@dataclass(frozen=True)
class PictureMeasures:
    """Means over pictures.

    Attributes:
        pictures: how many.
        noise: standard deviation in the calmest twentieth of the patches. [of 255 levels]
        lag_one: correlation of that noise between neighbours; NaN where there is no noise.
        mean: level. [of 255]
        dark_share, bright_share: pixels below 16 and above 250.
        edge_px: distance in which the steepest edges go from a tenth to nine tenths, median; NaN without edges. [px]
        blockiness: mean step across borders of blocks of 8 px over that elsewhere; 1 without blocks.
    """

    pictures: int
    noise: float
    lag_one: float
    mean: float
    dark_share: float
    bright_share: float
    edge_px: float
    blockiness: float


def measure_pictures(pictures: Iterable[NDArray[np.uint8]]) -> PictureMeasures:
    """Means over pictures as they are shown, (H, W, 3) or (H, W).

    Raises:
        ValueError: there are none.
    """
    rows = []
    for picture in pictures:
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        noise, lag_one = calm_noise(grey)
        shares = float((grey < _DARK_LEVEL).mean()), float((grey > _BRIGHT_LEVEL).mean())
        rows.append((noise, lag_one, float(grey.mean()), *shares, edge_width_px(grey), blockiness(grey)))
    if not rows:
        raise ValueError("pictures: there are none to measure")
    table = np.array(rows)
    known = ~np.isnan(table)
    sums, counts = np.where(known, table, 0.0).sum(axis=0), known.sum(axis=0)
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    return PictureMeasures(len(rows), *map(float, means))


def calm_noise(grey: NDArray[np.uint8]) -> tuple[float, float]:
    """Standard deviation and lag-one correlation of what is left of the calmest patches after a fitted plane.

    Clipped patches are left out. The choice and the fit take a little of the correlation: white noise gives -0.03.
    """
    height, width = (size // _PATCH_PX * _PATCH_PX for size in grey.shape)
    patches = grey[:height, :width].reshape(height // _PATCH_PX, _PATCH_PX, width // _PATCH_PX, _PATCH_PX)
    patches = patches.transpose(0, 2, 1, 3).reshape(-1, _PATCH_PX, _PATCH_PX).astype(np.float64)
    patches = patches[(patches.min(axis=(1, 2)) > 2) & (patches.max(axis=(1, 2)) < 253)]
    if not len(patches):
        return 0.0, float("nan")
    v, u = np.mgrid[:_PATCH_PX, :_PATCH_PX] - (_PATCH_PX - 1) / 2
    plane = np.stack([np.ones_like(u), u, v], axis=-1).reshape(-1, 3)
    left = patches.reshape(len(patches), -1)
    left = left - left @ plane @ np.linalg.inv(plane.T @ plane) @ plane.T
    order = np.argsort(left.std(axis=1))[: max(1, round(_CALM_SHARE * len(left)))]
    calm = left[order].reshape(-1, _PATCH_PX, _PATCH_PX)
    variance = float((calm**2).mean())
    if variance == 0:
        return 0.0, float("nan")
    return float(np.sqrt(variance)), float((calm[:, :, 1:] * calm[:, :, :-1]).mean() / variance)


def edge_width_px(grey: NDArray[np.uint8]) -> float:
    """Median distance from a tenth to nine tenths of the height of the steepest near-vertical edges. [px]"""
    level = grey.astype(np.float64)
    slope = np.zeros_like(level)
    slope[:, 1:-1] = np.abs(level[:, 2:] - level[:, :-2]) / 2
    slope[:, :_REACH_PX] = slope[:, -_REACH_PX:] = 0
    is_peak = (slope >= np.roll(slope, 1, axis=1)) & (slope > np.roll(slope, -1, axis=1))
    rows, columns = np.nonzero(is_peak & (slope > 8))
    steepest = np.argsort(-slope[rows, columns])[:_EDGES]
    widths = []
    for row, column in zip(rows[steepest], columns[steepest], strict=True):
        profile = level[row, column - _REACH_PX : column + _REACH_PX + 1]
        profile = profile if profile[-1] >= profile[0] else profile[::-1]
        low, high = profile[:4].mean(), profile[-4:].mean()
        if high - low < _LEAST_STEP:
            continue
        share = (profile - low) / (high - low)
        # From the middle of the edge outward, so that texture beside it does not count.
        begins = _crossing(share[: _REACH_PX + 2][::-1], 0.1)
        ends = _crossing(1.0 - share[_REACH_PX - 1 :], 0.1)
        if begins is not None and ends is not None:
            widths.append(begins + ends - 2)
    return float(np.median(widths)) if widths else float("nan")


def _crossing(falling: NDArray[np.float64], level: float) -> float | None:
    """Place at which samples fall below a level, linearly between them; None where they do not."""
    below = np.flatnonzero(falling < level)
    if not len(below) or below[0] == 0:
        return None
    k = int(below[0])
    return float(k - 1 + (falling[k - 1] - level) / (falling[k - 1] - falling[k]))


def blockiness(grey: NDArray[np.uint8]) -> float:
    """Mean step across the borders of blocks of 8 px over the mean step elsewhere."""
    step = np.abs(np.diff(grey.astype(np.float64), axis=1)).mean(axis=0)
    is_border = (np.arange(len(step)) + 1) % _BLOCK_PX == 0
    elsewhere = step[~is_border].mean()
    return float(step[is_border].mean() / elsewhere) if elsewhere > 0 else 1.0
