"""Input and output of every pose method: observation, stated tolerances, and solution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform
from geometry.stereo import StereoRig


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
    """

    rig: StereoRig
    layout: MarkerLayout
    pixels_px: Array
    cov_px2: Array
    hub_px: Array | None = None
    hub_cov_px2: Array | None = None
    tolerances: StatedTolerances = EXACT

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

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(2, N) which markers were measured."""
        seen: NDArray[np.bool_] = ~np.isnan(self.pixels_px).any(axis=2)
        return seen

    @property
    def hub_seen(self) -> NDArray[np.bool_]:
        """(2, 2) which edges of the hub were measured, by eye and edge."""
        assert self.hub_px is not None
        seen: NDArray[np.bool_] = ~np.isnan(self.hub_px).any(axis=2)
        return seen

    @property
    def paired(self) -> NDArray[np.bool_]:
        """(N,) which markers both eyes measured."""
        paired: NDArray[np.bool_] = self.seen.all(axis=0)
        return paired

    @property
    def sigma_px(self) -> float:
        """Root mean square of the standard deviations per axis of the measured centres. [px]"""
        variances = np.diagonal(self.cov_px2[self.seen], axis1=1, axis2=2)
        return float(np.sqrt(variances.mean()))


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
