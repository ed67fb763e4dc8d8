"""The classical rival of an edge fit: centre of mass of the light above the background."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nav.centroids.ellipses import Ellipses
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.outline_pixels import disc_pixels, edge_distances

# Pixels this far outside the outline see background only. [px]
_CLEAR_PX = 1.5


def grey_centroids(signals: Sequence[MarkerSignal], discs: Ellipses) -> np.ndarray:
    """Centres of mass in windows about the discs, the window's mean background subtracted.

    Shading shifts it by a share of the radius, and a window cut off unevenly does too: it is here to be compared with.

    Args:
        signals: left and right, around the discs.
        discs: where they are to half a pixel or so.

    Returns:
        (M, 2) centres, nan for discs whose window reaches over the edge of the image or holds no light. [px]
    """
    if len(discs) == 0:
        return np.zeros((0, 2))
    pixels = disc_pixels(signals, discs, everything=True)
    outside = pixels.present * (edge_distances(discs.shapes_px, pixels.x_px, pixels.y_px) < -_CLEAR_PX)
    background = (outside * pixels.values).sum(axis=1) / np.maximum(outside.sum(axis=1), 1)
    light = pixels.present * (pixels.values - background[:, None])
    total = light.sum(axis=1, dtype=np.float64)
    good = ~pixels.truncated & (total > 0)
    shift = np.stack([(light * pixels.x_px).sum(axis=1), (light * pixels.y_px).sum(axis=1)], axis=-1)
    centers: np.ndarray = np.full((len(discs), 2), np.nan)
    centers[good] = discs.centers_px[good] + shift[good] / total[good, None]
    return centers
