"""What every pose method is given and answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, StereoRig

# Three points fix a plane.
_LEAST_PAIRS = 3
# Markers are on a line when their spread across it is below this share of that along it; 89 degrees of tilt look so.
_COLLINEAR_FRACTION = 0.02
# A centre may lie outside the image when something else than our detector measured it, but not by more than its size.
_OUTSIDE_IMAGES = 1.0


@dataclass(frozen=True, eq=False)
class Observation:
    """Measured markers of one stereo pair, matched with the drogue.

    Attributes:
        rig: the stereo rig.
        layout: the drogue's markers.
        pixels_px: (2, N, 2) centres in the left and the right eye, nan where a marker was not measured.
        cov_px2: (2, N, 2, 2) their covariances.
    """

    rig: StereoRig
    layout: MarkerLayout
    pixels_px: Array
    cov_px2: Array

    def __post_init__(self) -> None:
        count = self.layout.count
        if self.pixels_px.shape != (2, count, 2):
            raise ValueError(f"pixels_px: must have shape (2, {count}, 2), got {self.pixels_px.shape}")
        if self.cov_px2.shape != (2, count, 2, 2):
            raise ValueError(f"cov_px2: must have shape (2, {count}, 2, 2), got {self.cov_px2.shape}")
        for name, values in (("pixels_px", self.pixels_px), ("cov_px2", self.cov_px2)):
            frozen = np.array(values, dtype=np.float64)
            frozen.flags.writeable = False
            object.__setattr__(self, name, frozen)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(2, N) which markers were measured."""
        seen: NDArray[np.bool_] = ~np.isnan(self.pixels_px).any(axis=2)
        return seen

    @property
    def paired(self) -> NDArray[np.bool_]:
        """(N,) which markers both eyes measured."""
        paired: NDArray[np.bool_] = self.seen.all(axis=0)
        return paired

    @property
    def sigma_px(self) -> float:
        """Root mean square standard deviation per axis of the measured centres. [px]"""
        variances = np.diagonal(self.cov_px2[self.seen], axis1=1, axis2=2)
        return float(np.sqrt(variances.mean()))


@dataclass(frozen=True, eq=False)
class PoseMode:
    """One pose that explains the images.

    Attributes:
        left_from_drogue: the pose.
        cost: half the sum of squared residuals in units of their standard deviations.
        weight: its share of the posterior.
    """

    left_from_drogue: RigidTransform
    cost: float
    weight: float


@dataclass(frozen=True, eq=False)
class Solution:
    """A pose.

    Attributes:
        left_from_drogue: modulo the layout's symmetry.
        used: (2, N) the measurements on which it rests.
        covariance: (6, 6) in the tangent `datasets_manifest.estimates.TANGENT`, or None.
        modes: the best first, where the method knows of several.
    """

    left_from_drogue: RigidTransform
    used: NDArray[np.bool_]
    covariance: Array | None = None
    modes: tuple[PoseMode, ...] = ()


@dataclass(frozen=True)
class NoFixReason:
    """Why there is no pose."""

    reason: str


PoseMethod = Callable[[Observation], Solution | NoFixReason]


def fault(observation: Observation) -> NoFixReason | None:
    """Why no pose can rest on an observation, or None when one can."""
    return _bad_numbers(observation) or _too_few_pairs(observation) or _degenerate(observation)


def _bad_numbers(observation: Observation) -> NoFixReason | None:
    size = np.array([observation.rig.camera.width_px, observation.rig.camera.height_px])
    for eye, pixels, covariances, seen in zip(
        EYES, observation.pixels_px, observation.cov_px2, observation.seen, strict=True
    ):
        for marker in np.flatnonzero(seen):
            x, y = pixels[marker]
            if (pixels[marker] < -_OUTSIDE_IMAGES * size).any() or (
                pixels[marker] > (1 + _OUTSIDE_IMAGES) * size
            ).any():
                return NoFixReason(f"marker {marker} of the {eye} eye lies far outside the image, at ({x:g}, {y:g}) px")
            (a, b), (c, d) = covariances[marker]
            if not np.isfinite(covariances[marker]).all() or a <= 0 or a * d - b * c <= 0:
                return NoFixReason(f"marker {marker} of the {eye} eye has no positive covariance")
    return None


def _too_few_pairs(observation: Observation) -> NoFixReason | None:
    left, right = observation.seen.sum(axis=1)
    if left == 0 or right == 0:
        return NoFixReason("no markers in either eye" if left == right else "markers in one eye only")
    pairs = int(observation.paired.sum())
    if pairs < _LEAST_PAIRS:
        return NoFixReason(f"{pairs} markers in both eyes, {_LEAST_PAIRS} are needed")
    return None


def _degenerate(observation: Observation) -> NoFixReason | None:
    paired = observation.paired
    for points in (observation.layout.centers_m[paired, :2], *observation.pixels_px[:, paired]):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= _COLLINEAR_FRACTION * spread[0]:
            return NoFixReason("the markers that both eyes see lie on one line")
    disparity_px = observation.pixels_px[0, paired, 0] - observation.pixels_px[1, paired, 0]
    if disparity_px.min() <= 0:
        return NoFixReason("a marker's disparity is not positive")
    return None
