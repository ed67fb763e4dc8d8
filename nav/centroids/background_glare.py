"""Bright light from beyond a dark face, where the picture does not take it off."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.patches import PixelSet
from nav.numerics.compiled import Array32

# Of a glaring sky a hundredth in a pixel is as much as a faint marker's noise.
_MOST_GLARE = 0.015
# Light from beyond is glaring where pixels beside an outline vary by more than this share of the contrast.
_GLARING_SHARE = 0.2
# So much of every edge must be left: on smaller images of a narrow face a fit would have too little to go by.
_LEAST_LEFT, _EDGE_PX = 0.5, 1.5
# Pixels so far from an outline show one side only. [px]
_CLEAR_PX = 1.0


def without_glare(
    pixels: PixelSet, signal: MarkerSignal, inwards_px: Array32, near: Callable[[float], Array32]
) -> NDArray[np.bool_] | None:
    """Which pixels hardly see what lies beyond a dark face, where it glares; None where it does not.

    Before a bright sky it is many times the contrast of what lies on the face, and a model of the face's edge that is
    off by hundredths of a pixel leaves more than the noise.

    Args:
        pixels: of outlines on the face.
        signal: one of those that they are from, which `shows_glare`.
        inwards_px: (N, K) distances into what lies on the face. [px]
        near: gives the (N, K) shares of light from beyond the face, were it narrower by so many pixels.
    """
    clear: NDArray[np.bool_] = near(signal.beside_px) < _MOST_GLARE
    present, outside = pixels.present > 0, inwards_px < -_CLEAR_PX
    lit, dark, beyond = (
        pixels.values[present & part] for part in (inwards_px > _CLEAR_PX, outside & clear, outside & ~clear)
    )
    if min(map(len, (lit, dark, beyond))) == 0:
        return None
    level = np.median(dark)
    contrast = np.median(lit) - level
    glare = np.sqrt(max(np.mean((beyond - level) ** 2) - np.var(dark), 0.0))
    if glare < _GLARING_SHARE * contrast:
        return None
    # What differs by more than that lies beyond too, should the face end earlier than it is said to.
    clear &= ~(outside & (np.abs(pixels.values - level) > contrast))
    edge = present & (np.abs(inwards_px) < _EDGE_PX)
    return clear if ((edge & clear).sum(axis=1) >= _LEAST_LEFT * edge.sum(axis=1)).all() else None
