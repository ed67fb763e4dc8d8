"""Where one colour measures a disc better than its lead over the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geometry.se3 import Array
from nav.centroids.centroid_quality import NoiseModel
from nav.centroids.patches import PixelSet
from nav.numerics.levenberg_marquardt import Minimum

# Square of a centre's move over its variance, of two coordinates: even light exceeds it once in a hundred discs.
_MOST_MOVED = 9.2
# The others' variance beside a marker is at most that of their difference from the colour, of which it is a part; and
# where that is above this share of the variance on the marker, it is more than noise.
_MOST_DARK_SHARE = 0.6


def with_even_others(fit: Minimum, pixels: PixelSet, noise: NoiseModel, contrast: Array) -> tuple[Minimum, PixelSet]:
    """Put back what the difference of colours took off, where that was nothing but noise.

    The difference keeps sky and shadows out, at the price of the other colours' noise. Near by, a disc's window holds
    little but paint and dark face, both even in the other colours; whether they are, the others themselves tell: they
    must not move the centre by more than their own noise does. Overlooked unevenness so moves it by less than what
    leaving the noise in would.

    Args:
        fit: to the difference.
        pixels: of it.
        noise: of it.
        contrast: (N,) light of the discs above that beside them. [DN]

    Returns:
        The fit after one linear step, and the pixels, where the others are even those of the one colour.
    """
    bright_dn2 = noise.dark_dn2 + noise.per_signal_dn * np.median(contrast)
    if pixels.others is None or noise.dark_dn2 > _MOST_DARK_SHARE * bright_dn2:
        return fit, pixels
    weights = pixels.present
    shift = replace(fit, parameters=np.zeros_like(fit.parameters)).given(pixels.others, weights)
    freedom = np.maximum(weights.sum(axis=1) - fit.parameters.shape[1], 1)
    variance = (shift.residuals**2 * weights).sum(axis=1) / freedom
    unit_cov = fit.covariance()[:, :2, :2]
    moved: Array = np.einsum("ni,nij,nj->n", shift.parameters[:, :2], np.linalg.inv(unit_cov), shift.parameters[:, :2])
    even = (moved < _MOST_MOVED * variance) & (variance < noise.dark_dn2)
    back = pixels.others * even[:, None]
    return fit.given(fit.residuals + back, weights), replace(pixels, values=pixels.values + back)
