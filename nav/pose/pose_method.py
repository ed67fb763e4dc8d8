"""Input and output of every pose method: observation and its checks, stated tolerances, and solution."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, StereoRig
from nav.numerics.medians import median


@dataclass(frozen=True)
class StatedTolerances:
    """Standard deviations of the drogue and rig about their nominal dimensions; 0, the default, means exactly as built.

    Least-squares methods use them: an error that all markers share becomes an unknown with this prior; an independent
    error of each marker is added to the covariance of its two images.

    Attributes:
        ring_radius_m: of the circle through the markers.
        ellipticity: difference of that circle's axes over their mean, along an unknown direction; its size, not a
            standard deviation.
        placement_m: of every marker along each axis.
        hub_lateral_m: of the hub along both axes perpendicular to the drogue's.
        disparity_px: of the right eye's columns. A yaw error of the right camera shifts them by the focal length in
            pixels times the angle, an error of its principal point by that error.
    """

    ring_radius_m: float = 0.0
    ellipticity: float = 0.0
    placement_m: float = 0.0
    hub_lateral_m: float = 0.0
    disparity_px: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{field.name}: must be 0 or more, got {value}")


EXACT = StatedTolerances()


# The hub annulus has an inner and an outer edge, in this order; each has its own ellipse centre.
HUB_EDGES = 2
INNER_EDGE, OUTER_EDGE = range(HUB_EDGES)


@dataclass(frozen=True, eq=False)
class RimEdges:
    """Points on the rim's outer edge in the ideal images.

    Attributes:
        eyes: (K,) 0 for the left eye, 1 for the right one.
        points_px: (K, 2). [px]
        normals: (K, 2) unit vectors across the edge, away from the drogue.
        sigma_px: (K,) standard deviations along the normals. [px]
        seen_fraction: (2,) share of the circumference on which either eye shows an edge.
        darkness: (2,) share of the background's light that is missing inside the edge, in four fifths of what is seen.
    """

    eyes: NDArray[np.int64]
    points_px: Array
    normals: Array
    sigma_px: Array
    seen_fraction: tuple[float, float]
    darkness: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Observation:
    """Measured features of one stereo pair, matched with the drogue.

    Attributes:
        rig: the stereo rig.
        layout: the drogue's markers and hub.
        pixels_px: (2, N, 2) centres in the left and the right eye, nan where a marker was not measured.
        cov_px2: (2, N, 2, 2) their covariances.
        hub_px: (2, 2, 2) ellipse centres of the hub's inner and outer edge in each eye, nan where not measured; None
            for no hub.
        hub_cov_px2: (2, 2, 2, 2) their covariances; None where `hub_px` is None.
        tolerances: of the true drogue and rig about `layout` and `rig`.
        rim: the rim's edge, or None where it was not measured.
    """

    rig: StereoRig
    layout: MarkerLayout
    pixels_px: Array
    cov_px2: Array
    hub_px: Array | None = None
    hub_cov_px2: Array | None = None
    tolerances: StatedTolerances = EXACT
    rim: RimEdges | None = None

    def __post_init__(self) -> None:
        if (self.hub_px is None) != (self.hub_cov_px2 is None):
            raise ValueError("hub_px, hub_cov_px2: give both or neither, got one")
        if self.hub_px is None:
            object.__setattr__(self, "hub_px", np.full((2, HUB_EDGES, 2), np.nan))
            object.__setattr__(self, "hub_cov_px2", np.full((2, HUB_EDGES, 2, 2), np.nan))
        count = self.layout.count
        for name, shape in (
            ("pixels_px", (2, count, 2)),
            ("cov_px2", (2, count, 2, 2)),
            ("hub_px", (2, HUB_EDGES, 2)),
            ("hub_cov_px2", (2, HUB_EDGES, 2, 2)),
        ):
            frozen = np.array(getattr(self, name), dtype=np.float64)
            if frozen.shape != shape:
                raise ValueError(f"{name}: must have shape {shape}, got {frozen.shape}")
            frozen.flags.writeable = False
            object.__setattr__(self, name, frozen)
        if self.layout.hub_center_m is None and self.hub_seen.any():
            raise ValueError("hub_px: the drogue has no hub, got a measured one")

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(2, N) which markers were measured."""
        return _measured(self.pixels_px)

    @cached_property
    def hub_seen(self) -> NDArray[np.bool_]:
        """(2, 2) which edges of the hub were measured, by eye and edge."""
        assert self.hub_px is not None
        return _measured(self.hub_px)

    @cached_property
    def paired(self) -> NDArray[np.bool_]:
        """(N,) which markers both eyes measured."""
        paired: NDArray[np.bool_] = self.seen[0] & self.seen[1]
        paired.flags.writeable = False
        return paired

    @property
    def sigma_px(self) -> float:
        """Root mean square of the standard deviations per axis of the measured centres. [px]"""
        variances = np.diagonal(self.cov_px2[self.seen], axis1=1, axis2=2)
        return float(np.sqrt(variances.mean()))


def _measured(pixels_px: Array) -> NDArray[np.bool_]:
    """(E, F) which places (E, F, 2) are numbers."""
    measured: NDArray[np.bool_] = ~np.isnan(pixels_px).any(axis=2)
    measured.flags.writeable = False
    return measured


@dataclass(frozen=True, eq=False)
class PoseMode:
    """One of the poses that explain the images.

    Attributes:
        left_from_drogue: the pose.
        cost: half the sum of squared residuals in units of their standard deviations, priors included.
        weight: its posterior probability.
    """

    left_from_drogue: RigidTransform
    cost: float
    weight: float


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a pose method.

    Attributes:
        left_from_drogue: the pose, modulo the layout's symmetry.
        used: (2, N) the measurements of markers that it uses.
        covariance: (6, 6) in the tangent `datasets_manifest.types.estimates.TANGENT`, or None.
        modes: all poses that the method found, the best first; empty where it finds only one.
        used_hub: (2, 2) the measurements of the hub's edges that it uses, or None for a method without hub.
        note: a remark for the user in one sentence, or empty.
    """

    left_from_drogue: RigidTransform
    used: NDArray[np.bool_]
    covariance: Array | None = None
    modes: tuple[PoseMode, ...] = ()
    used_hub: NDArray[np.bool_] | None = None
    note: str = ""


@dataclass(frozen=True)
class NoFixReason:
    """Why there is no pose."""

    reason: str


PoseMethod = Callable[[Observation], Solution | NoFixReason]


# Three points determine a plane.
_LEAST_PAIRS = 3
# Points are collinear when their spread across a line is below this share of that along it: a tilt of 89 degrees.
_COLLINEAR_FRACTION = 0.02
# Measurements from elsewhere may lie outside the image, but by no more than its size.
_OUTSIDE_IMAGES = 1.0
# Largest difference of a covariance's two mixed entries, over the root of the variances' product: rounding.
_ASYMMETRY = 1e-6
# A ring tilted by 60 degrees appears a quarter smaller on average; the rest allows for noise at long range.
_RIG_MISMATCH_FRACTION, _RIG_MISMATCH_PX = 0.35, 1.0


def stereo_fault(observation: Observation, allows_outliers: bool = False) -> NoFixReason | None:
    """Why no pose can be computed from the markers in both eyes; None when one can.

    Args:
        observation: the markers.
        allows_outliers: whether a few markers may be wrong, as the method finds them.
    """
    return (
        _invalid_numbers(observation, observation.pixels_px, observation.cov_px2, "marker")
        or _too_few_pairs(observation)
        or _degenerate_pairs(observation, allows_outliers)
        or _rig_mismatch(observation)
    )


def hub_fault(observation: Observation) -> NoFixReason | None:
    """Why the measured edges of the hub are invalid; None when they are valid."""
    assert observation.hub_px is not None
    assert observation.hub_cov_px2 is not None
    return _invalid_numbers(observation, observation.hub_px, observation.hub_cov_px2, "hub edge")


def eye_fault(observation: Observation, eye: int, least: int) -> NoFixReason | None:
    """Why no pose can be computed from the markers of one eye, 0 left or 1 right; None when one can."""
    pixels, cov = observation.pixels_px[eye : eye + 1], observation.cov_px2[eye : eye + 1]
    reason = _invalid_numbers(observation, pixels, cov, "marker", eye)
    if reason is not None:
        return reason
    seen = observation.seen[eye]
    if seen.sum() < least:
        return NoFixReason(f"{int(seen.sum())} markers in the {EYES[eye]} eye, {least} are needed")
    if _is_collinear(observation.layout.centers_m[seen, :2]) or _is_collinear(observation.pixels_px[eye, seen]):
        return NoFixReason(f"the markers that the {EYES[eye]} eye sees lie on one line")
    return None


def _invalid_numbers(
    observation: Observation, pixels: Array, cov: Array, what: str, first_eye: int = 0
) -> NoFixReason | None:
    """Why places (E, F, 2) of E eyes, or their covariances (E, F, 2, 2), cannot be right; None when they can."""
    size = np.array([observation.rig.camera.width_px, observation.rig.camera.height_px])
    seen = _measured(pixels)
    outside = seen & ((pixels < -_OUTSIDE_IMAGES * size) | (pixels > (1 + _OUTSIDE_IMAGES) * size)).any(axis=2)
    if outside.any():
        eye, index = np.argwhere(outside)[0].tolist()
        x, y = pixels[eye, index]
        where = f"{what} {index} of the {EYES[first_eye + eye]} eye"
        return NoFixReason(f"{where} lies far outside the image, at ({x:g}, {y:g}) px")
    # Products of huge or infinite entries are nan, which fails the comparisons below; a finite sum has finite terms.
    with np.errstate(invalid="ignore", over="ignore"):
        a, b, c, d = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 0], cov[..., 1, 1]
        determinant = a * d - b * c
        sound = (a > 0) & (determinant > 0) & np.isfinite(determinant + a + b + c + d)
        symmetric = np.abs(b - c) <= _ASYMMETRY * np.sqrt(a * d)
    for good, kind in ((sound, "positive"), (symmetric, "symmetric")):
        bad = seen & ~good
        if bad.any():
            eye, index = np.argwhere(bad)[0].tolist()
            return NoFixReason(f"{what} {index} of the {EYES[first_eye + eye]} eye has no {kind} covariance")
    return None


def _too_few_pairs(observation: Observation) -> NoFixReason | None:
    left, right = observation.seen.sum(axis=1)
    if left == 0 or right == 0:
        return NoFixReason("no markers in either eye" if left == right else "markers in one eye only")
    pairs = int(observation.paired.sum())
    if pairs < _LEAST_PAIRS:
        return NoFixReason(f"{pairs} markers in both eyes, {_LEAST_PAIRS} are needed")
    return None


def _degenerate_pairs(observation: Observation, allows_outliers: bool) -> NoFixReason | None:
    paired = observation.paired
    for points in (observation.layout.centers_m[paired, :2], *observation.pixels_px[:, paired]):
        if _is_collinear(points):
            return NoFixReason("the markers that both eyes see lie on one line")
    disparity_px = observation.pixels_px[0, paired, 0] - observation.pixels_px[1, paired, 0]
    if (median(disparity_px) if allows_outliers else disparity_px.min()) <= 0:
        return NoFixReason("a marker's disparity is not positive")
    return None


def _rig_mismatch(observation: Observation) -> NoFixReason | None:
    """Whether disparities and the ring's size imply different distances, as with the wrong rig or drogue."""
    paired = observation.paired
    first, second = _pairs_of(int(paired.sum()))
    places, pixels = observation.layout.centers_m[paired], observation.pixels_px[:, paired]
    gaps_m, gaps_px = places[first] - places[second], pixels[:, first] - pixels[:, second]
    # Medians, so that one or two outliers do not count.
    # As if pixels were square, since disparities are along x.
    gaps_px = gaps_px * (1.0, observation.rig.camera.fx_px / observation.rig.camera.fy_px)
    px_per_m = np.sqrt((gaps_px**2).sum(axis=2) / (gaps_m**2).sum(axis=1))
    expected_px = observation.rig.baseline_m * median(px_per_m)
    disparity_px = median(pixels[0, :, 0] - pixels[1, :, 0])

    def fits(size_px: float) -> bool:
        return abs(disparity_px - size_px) <= _RIG_MISMATCH_FRACTION * min(disparity_px, size_px) + _RIG_MISMATCH_PX

    # Where only neighbouring markers of a tilted ring are seen, all gaps are foreshortened alike; the longest axis of
    # the affine map from drogue to image is not.
    if fits(expected_px) or fits(observation.rig.baseline_m * _largest_scale_px_per_m(observation)):
        return None
    return NoFixReason(
        f"rig and drogue do not fit: markers this large have a disparity of {expected_px:.1f} px, "
        f"these have {disparity_px:.1f} px"
    )


@cache
def _pairs_of(count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of the first and of the second of all pairs of so many markers."""
    first, second = np.triu_indices(count, 1)
    first.flags.writeable = second.flags.writeable = False
    return first, second


def _largest_scale_px_per_m(observation: Observation) -> float:
    """Largest singular value of the affine map from the markers' plane to an image, mean of both eyes. [px/m]"""
    paired = observation.paired
    arms_m = observation.layout.centers_m[paired, :2]
    arms_m = arms_m - arms_m.mean(axis=0)
    maps = [np.linalg.lstsq(arms_m, px - px.mean(axis=0), rcond=None)[0] for px in observation.pixels_px[:, paired]]
    return float(np.mean([np.linalg.svd(map_, compute_uv=False)[0] for map_ in maps]))


def _is_collinear(points: Array) -> bool:
    # The squared spreads along and across the line are the eigenvalues of the (2, 2) second moment, in closed form.
    arms = points - points.sum(axis=0) / len(points)
    (xx, xy), (_, yy) = (arms.T @ arms).tolist()
    middle, apart = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    return bool(middle - apart <= _COLLINEAR_FRACTION**2 * (middle + apart))
