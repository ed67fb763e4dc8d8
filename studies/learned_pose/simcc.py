"""SimCC: coordinates as classification, in bins finer than a pixel.

A keypoint's x and y are two distributions over bins. Training compares them with Gaussians about the true coordinates.
The coordinate is read as the mean of the distribution about its peak, so that a second peak, as where the order of the
keypoints is about to change, does not pull it.

Source: Y. Li et al., SimCC, ECCV 2022, doi:10.1007/978-3-031-20068-7_6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from studies.learned_pose.keypoint_crops import CROP_PX

BINS_PER_PX = 2
BINS = BINS_PER_PX * CROP_PX
SIGMA_BINS = 3.0
"""Standard deviation of the Gaussian about the true coordinate: 1.5 px of the crop."""
WINDOW_BINS = 12
"""Bins to both sides of the peak that are averaged: four standard deviations."""


class Decoded(NamedTuple):
    """Keypoints of one crop.

    Attributes:
        points_px: (K, 2) in pixel-centre coordinates of the crop. [px]
        shares: (K,) the smaller of the shares of both distributions that lie about the peak; 1 for one clear peak.
    """

    points_px: Array
    shares: Array


def bin_of(coordinates_px: Array) -> Array:
    """Real-valued bins of coordinates; the crop's first pixel has the bins 0 and 1. [bins]"""
    bins: Array = BINS_PER_PX * (coordinates_px + 0.5) - 0.5
    return bins


def encode(points_px: Array) -> NDArray[np.float32]:
    """Target distributions of keypoints.

    Args:
        points_px: (K, 2) in pixel-centre coordinates of the crop. [px]

    Returns:
        (2, K, BINS) Gaussians for x and for y, each of sum 1.
    """
    offsets = np.arange(BINS) - bin_of(np.asarray(points_px).T)[..., None]
    # Relative to the nearest bin, so that a point outside the crop has a sum above zero.
    exponents = -(offsets**2) / (2 * SIGMA_BINS**2)
    weights = np.exp(exponents - exponents.max(axis=-1, keepdims=True))
    targets: NDArray[np.float32] = (weights / weights.sum(axis=-1, keepdims=True)).astype(np.float32)
    return targets


def decode(logits: NDArray[np.float32]) -> Decoded:
    """Keypoints from the network's answer (2, K, BINS) for one crop."""
    values = logits.astype(np.float64)
    weights = np.exp(values - values.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    bins = np.arange(BINS)
    near = np.abs(bins - np.argmax(weights, axis=-1)[..., None]) <= WINDOW_BINS
    inside = np.where(near, weights, 0.0)
    shares = inside.sum(axis=-1)
    means = (inside * bins).sum(axis=-1) / shares
    points = ((means + 0.5) / BINS_PER_PX - 0.5).T
    return Decoded(points, shares.min(axis=0))
