"""Where the fit of large discs starts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nav.centroids.disc_rejection import LARGEST_SCALE
from nav.centroids.ellipses import Ellipses, moment_shapes, shape_radii
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.patches import WHOLE_RADIUS_PX, coarse_pixels, edge_distances


def located(signals: Sequence[MarkerSignal], discs: Ellipses) -> Ellipses:
    """Initial outlines of large discs from second moments, since a circle misses a tilted disc's edge by pixels."""
    if discs.radii_px.max() <= WHOLE_RADIUS_PX:
        return discs
    pixels = coarse_pixels(signals, discs)
    distance = edge_distances(discs.shapes_px, pixels.x_px, pixels.y_px)
    levels = []
    for side in (distance < 0, distance > 0):
        weight = pixels.present * side
        levels.append((weight * pixels.values).sum(axis=1) / np.maximum(weight.sum(axis=1), 1))
    bright = pixels.present * (pixels.values > ((levels[0] + levels[1]) / 2)[:, None])
    places = np.stack([pixels.x_px, pixels.y_px], axis=-1).astype(np.float64)
    total = np.maximum(bright.sum(axis=1), 1)
    center = np.einsum("nk,nki->ni", bright, places) / total[:, None]
    arms = places - center[:, None]
    shapes = moment_shapes(np.einsum("nk,nki,nkj->nij", bright, arms, arms) / total[:, None, None])
    scale = shape_radii(shapes) / discs.radii_px
    good = (scale > 1 / LARGEST_SCALE) & (scale < LARGEST_SCALE)
    centers = np.where(good[:, None], discs.centers_px + center, discs.centers_px)
    return Ellipses(discs.eyes, centers, np.where(good[:, None, None], shapes, discs.shapes_px))
