"""Which fits of discs are not to be believed."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array
from nav.centroids.centroid_quality import NoiseModel, ResidualSpread
from nav.centroids.disc_model import contrasts
from nav.centroids.edge_profile import parameter_shapes
from nav.centroids.ellipses import Ellipses, are_positive, shape_radii
from nav.centroids.patches import PixelSet
from nav.numerics.compiled import Array32
from nav.numerics.levenberg_marquardt import Minimum

# Of a pixel's noise: fainter discs start from noise and end anywhere. Small ones are told by so few pixels that their
# centre's own deviation [px] says when they are too faint.
_LEAST_CONTRAST_SIGMA = 2.5
_LARGEST_SIGMA_PX = 0.2
# Of a disc's own pixels; a wholly clipped disc keeps its middle, one clipped in part does not.
_MOST_CLIPPED_FRACTION = 0.05
# Residuals of twice the frame's noise and of more than this share of the contrast are those of another thing.
_LARGEST_CHI2, _ROUGH_SHARE = 4.0, 0.04
# An outline that ends this far from its start, as a share of its radius, is another thing's.
_LARGEST_MOVE_FRACTION = 0.5
LARGEST_SCALE = 1.6


def rejection_reasons(
    discs: Ellipses,
    pixels: PixelSet,
    fit: Minimum,
    inside: Array32,
    cov_px2: Array,
    noise: NoiseModel,
    spread: ResidualSpread,
) -> tuple[str | None, ...]:
    """Why each disc is rejected, the plainest reason first."""
    contrast, own = contrasts(fit), pixels.present * (inside > 0.5)
    clipped = (own * pixels.clipped).sum(axis=1) / np.maximum(own.sum(axis=1), 1)
    bright = noise.dark_dn2 + noise.per_signal_dn * np.maximum(contrast, 0)
    moved = np.hypot(*(fit.parameters[:, :2] + pixels.origins_px - discs.centers_px).T)
    shapes = parameter_shapes(fit.parameters)
    scale = shape_radii(shapes) / discs.radii_px
    rough = (spread.chi2_per_dof > _LARGEST_CHI2) & (spread.chi2_per_dof * bright > (_ROUGH_SHARE * contrast) ** 2)
    lost = ~np.isfinite(fit.parameters).all(axis=1) | ~np.isfinite(cov_px2).all(axis=(1, 2)) | ~are_positive(shapes)
    placed = np.einsum("nii->n", cov_px2) < 2 * _LARGEST_SIGMA_PX**2
    astray = (moved > 1 + _LARGEST_MOVE_FRACTION * discs.radii_px) | ~(
        (scale > 1 / LARGEST_SCALE) & (scale < LARGEST_SCALE)
    )
    tests = (
        (pixels.truncated, "cut by the edge of the image"),
        (clipped > _MOST_CLIPPED_FRACTION, "clipped: brighter than the sensor's range"),
        (~(contrast > _LEAST_CONTRAST_SIGMA * np.sqrt(bright)), "no contrast"),
        (lost | astray, "the fit left the disc"),
        (spread.uneven | rough, "uneven: cut by a shadow or hidden in part"),
        (~placed, "too faint to be placed"),
    )
    return tuple(next((reason for failed, reason in tests if failed[i]), None) for i in range(len(discs)))
