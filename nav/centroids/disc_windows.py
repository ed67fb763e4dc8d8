"""Windows of pixels around small discs, in every colour that the sensor measures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import StereoImages
from geometry.se3 import Array
from geometry.stereo import EYES
from nav.centroids.ellipses import Ellipses
from nav.matching.marker_channel import linear_light
from nav.numerics.compiled import Array32

# Margin of a window around a disc. [px]
_MARGIN_PX = 3.5
# Bayer's cell RGGB: the class of the site at the row's and the column's parity.
_SITES = np.array([[0, 1], [1, 2]])


@dataclass(frozen=True, eq=False)
class DiscWindows:
    """Windows of pixels around N discs, all of one size.

    Attributes:
        values: (N, K) light above the black level. [DN]
        present: (N, K) 1 for samples that are used, 0 for clipped ones and those beyond the image.
        classes: (N, C, K) 1 where a sample is of that colour.
        x_px, y_px: (N, K) places from `middles_px`.
        middles_px: (N, 2) middle pixels of the windows.
        half: windows have 2 half + 1 pixels a side; K is their number, or three times that in a colour image.
    """

    values: Array32
    present: Array32
    classes: Array32
    x_px: Array32
    y_px: Array32
    middles_px: Array
    half: int

    def samples(self, pictures: Array) -> Array32:
        """(M, K) samples of pictures (M, W, W), the same in every colour."""
        flat = pictures.reshape(len(pictures), -1).astype(np.float32)
        return np.ascontiguousarray(np.tile(flat, (1, self.values.shape[1] // flat.shape[1])))


def cut_windows(images: StereoImages, discs: Ellipses) -> DiscWindows:
    """Windows around the middles of discs, wide enough for the light of the largest."""
    half = int(np.ceil(discs.radii_px.max() + _MARGIN_PX))
    offsets = np.arange(-half, half + 1)
    middles = np.rint(discs.centers_px).astype(np.int64)
    columns, rows = middles[:, :1] + offsets, middles[:, 1:] + offsets
    width, height = images.size_px
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < width))[:, None, :]
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    parts = []
    for index in np.unique(discs.eyes):
        mine = np.flatnonzero(discs.eyes == index)
        left, top = int(columns[mine].min()), int(rows[mine].min())
        window = left, top, int(columns[mine].max()) + 1, int(rows[mine].max()) + 1
        light, clipped = linear_light(images, EYES[index], window)
        place = rows[mine][:, :, None] - top, columns[mine][:, None, :] - left
        parts.append(
            (mine, light[place], inside[mine].reshape(inside[mine].shape + (1,) * (light.ndim - 2)) & ~clipped[place])
        )
    order = np.argsort(np.concatenate([mine for mine, _, _ in parts]))
    values, present = (_by_color(np.concatenate([part[place] for part in parts])[order]) for place in (1, 2))
    if images.left_mosaic is not None:
        site = _SITES[rows[:, :, None] % 2, columns[:, None, :] % 2].reshape(len(discs), 1, -1)
        classes = (site == np.arange(_SITES.max() + 1)[:, None]).astype(np.float32)
    else:
        planes = values.shape[1] // len(offsets) ** 2
        one = np.repeat(np.eye(planes, dtype=np.float32), len(offsets) ** 2, axis=1)
        classes = np.broadcast_to(one, (len(discs), *one.shape))
    y, x = (np.broadcast_to(each, (len(discs), *each.shape)) for each in np.meshgrid(offsets, offsets, indexing="ij"))
    empty = DiscWindows(values, present.astype(np.float32), classes, values, values, middles.astype(np.float64), half)
    return replace(empty, x_px=empty.samples(x), y_px=empty.samples(y))


def _by_color(pixels: NDArray[Any]) -> NDArray[Any]:
    """(N, K) samples of windows (N, W, W) or (N, W, W, 3), one colour after the other."""
    return np.ascontiguousarray(np.moveaxis(pixels, 3, 1) if pixels.ndim == 4 else pixels).reshape(len(pixels), -1)
