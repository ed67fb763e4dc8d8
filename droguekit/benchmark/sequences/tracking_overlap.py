"""How well boxes follow true ones: overlap, distance of the centres, and the curves of the OTB benchmark.

Source: Y. Wu, J. Lim, M.-H. Yang, CVPR 2013, doi:10.1109/CVPR.2013.312, success and precision plots; M. Mueller et al.,
TrackingNet, ECCV 2018, doi:10.1007/978-3-030-01246-5_19, precision normalised by the size of the true box.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array

OVERLAPS: Array = np.linspace(0.0, 1.0, 21)
"""Overlaps of the success plot."""
CENTER_ERRORS_PX: Array = np.arange(0.0, 51.0)
"""Distances of the precision plot. [px]"""
NORMALIZED_ERRORS: Array = np.linspace(0.0, 0.5, 51)
"""Distances of the normalised precision plot, in sizes of the true box."""
PRECISION_AT_PX = 20.0
"""Where the precision plot is read off. [px]"""
NO_BOX = (np.nan, np.nan, np.nan, np.nan)


def center_errors_px(found: Array, truth: Array) -> Array:
    """(n,) distances of the centres of (n, 4) boxes; infinite where a box is `NO_BOX`. [px]"""
    return _lengths(_center_offsets(found, truth))


def normalized_center_errors(found: Array, truth: Array) -> Array:
    """(n,) the same with offsets to the side over the true box's width, and up or down over its height."""
    return _lengths(_center_offsets(found, truth) / truth[:, 2:])


def success_curve(overlap: Array) -> Array:
    """(21,) share of the images whose overlap is larger than each of `OVERLAPS`."""
    return _shares(overlap[:, None] > OVERLAPS)


def precision_curve(errors: Array, limits: Array) -> Array:
    """(len(limits),) share of the images whose error is at most each of the limits."""
    return _shares(errors[:, None] <= limits)


def _center_offsets(found: Array, truth: Array) -> Array:
    offsets: Array = found[:, :2] + found[:, 2:] / 2 - truth[:, :2] - truth[:, 2:] / 2
    return offsets


def _lengths(offsets: Array) -> Array:
    lengths: Array = np.nan_to_num(np.hypot(offsets[:, 0], offsets[:, 1]), nan=np.inf)
    return lengths


def _shares(passed: NDArray[np.bool_]) -> Array:
    shares: Array = np.mean(passed, axis=0)
    return shares
