"""Discs as the edge model found them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.centroids.centroid_quality import NoiseModel
from nav.centroids.ellipses import Ellipses
from nav.centroids.motion_blur import Travel


@dataclass(frozen=True, eq=False)
class DiscFits:
    """Refined discs, in the order of the initial ones.

    Attributes:
        ellipses: fitted outlines; the initial ones where a fit was rejected.
        cov_px2: (M, 2, 2) covariances of the centres.
        contrast_dn, background_dn: (M,) light of the disc above that beside it, and the latter. [DN]
        edge_width_px: (M,) Gaussian width of the edge, pixel's box included.
        chi2_per_dof: (M,) of the residuals against the frame's own noise.
        inflation: (M,) factor in `cov_px2` for residuals that hang together.
        reasons: why a disc was rejected, or None.
        noise: of the frame's pixels, None without any disc.
        travel: how the discs moved while the shutter was open, None where they stood still.
    """

    ellipses: Ellipses
    cov_px2: Array
    contrast_dn: Array
    background_dn: Array
    edge_width_px: Array
    chi2_per_dof: Array
    inflation: Array
    reasons: tuple[str | None, ...]
    noise: NoiseModel | None
    travel: Travel | None = None

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(M,) which discs were not rejected."""
        return np.array([reason is None for reason in self.reasons], dtype=np.bool_)


def unfitted(discs: Ellipses) -> DiscFits:
    """Discs as they were, to be replaced by `merged`."""
    count = len(discs)
    nothing = np.zeros(count)
    return DiscFits(discs, np.zeros((count, 2, 2)), nothing, nothing, nothing, nothing, nothing, (None,) * count, None)


def merged(fits: DiscFits, index: NDArray[np.int64], part: DiscFits) -> DiscFits:
    """`fits` with those of `index` replaced."""

    def put(old: Array, new: Array) -> Array:
        merged = old.copy()
        merged[index] = new
        return merged

    reasons = list(fits.reasons)
    for place, reason in zip(index, part.reasons, strict=True):
        reasons[place] = reason
    centers = put(fits.ellipses.centers_px, part.ellipses.centers_px)
    shapes = put(fits.ellipses.shapes_px, part.ellipses.shapes_px)
    return DiscFits(
        Ellipses(fits.ellipses.eyes, centers, shapes),
        put(fits.cov_px2, part.cov_px2),
        put(fits.contrast_dn, part.contrast_dn),
        put(fits.background_dn, part.background_dn),
        put(fits.edge_width_px, part.edge_width_px),
        put(fits.chi2_per_dof, part.chi2_per_dof),
        put(fits.inflation, part.inflation),
        tuple(reasons),
        part.noise,
        fits.travel if part.travel is None else part.travel,
    )
