"""Drogues and cameras that are not exactly as built; the estimator knows the nominal ones, and what is stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from geometry.stereo import StereoRig
from nav.pose.stated_tolerances import StatedTolerances
from studies.acceptance.centroid_level.drawn_poses import RightEyeErrors


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of each draw about the nominal value; the ellipticity is the same in every draw.

    Attributes:
        ring_radius_m: of the marker circle.
        placement_m: of every marker along each axis.
        ellipticity: difference of the ring's axes over their mean, along a drawn direction.
        hub_lateral_m: of the hub's centre along both axes across the drogue's.
        right_yaw_deg: of the right camera.
        right_cx_px: of the right camera's principal point.
    """

    ring_radius_m: float = 0.0
    placement_m: float = 0.0
    ellipticity: float = 0.0
    hub_lateral_m: float = 0.0
    right_yaw_deg: float = 0.0
    right_cx_px: float = 0.0


AS_BUILT = Tolerances()
RING_ONLY = Tolerances(ring_radius_m=0.5e-3)
TOLERANCED = Tolerances(0.5e-3, 0.3e-3, 0.002, 1e-3, 0.005, 0.05)


def stated_tolerances(tolerances: Tolerances, rig: StereoRig) -> StatedTolerances:
    """The same, as a user would state it to an estimator."""
    yaw_px = rig.camera.fx_px * float(np.radians(tolerances.right_yaw_deg))
    return StatedTolerances(
        ring_radius_m=tolerances.ring_radius_m,
        ellipticity=tolerances.ellipticity,
        placement_m=tolerances.placement_m,
        hub_lateral_m=tolerances.hub_lateral_m,
        disparity_px=float(np.hypot(yaw_px, tolerances.right_cx_px)),
    )


@dataclass(frozen=True, eq=False)
class TrueFeatures:
    """What is really there in each draw.

    Attributes:
        centers_m: (n, F, 3) markers, then the hub where there is one.
        right: departures of the right camera.
    """

    centers_m: Array
    right: RightEyeErrors


def draw_features(rng: np.random.Generator, layout: MarkerLayout, tolerances: Tolerances, count: int) -> TrueFeatures:
    """True features of `count` drogues and cameras.

    Args:
        rng: the stream.
        layout: the nominal drogue, its markers on one circle.
        tolerances: how far it departs.
        count: how many draws.

    Raises:
        ValueError: markers that lie on no circle.
    """
    if layout.ring_radius_m is None:
        raise ValueError("drogue: its markers must lie on one circle to have a tolerance of the radius")
    radius = 1 + tolerances.ring_radius_m / layout.ring_radius_m * rng.standard_normal(count)
    direction = np.pi * rng.random(count)
    long_axis = np.stack([np.cos(direction), np.sin(direction), np.zeros(count)], axis=-1)
    nominal = layout.centers_m
    along = nominal @ long_axis.T
    stretched = nominal + tolerances.ellipticity * (along.T[..., None] * long_axis[:, None] - nominal / 2)
    placed = tolerances.placement_m * rng.standard_normal((count, layout.count, 3))
    markers = radius[:, None, None] * stretched + placed
    lateral = tolerances.hub_lateral_m * rng.standard_normal((count, 1, 3)) * np.array([1.0, 1.0, 0.0])
    if layout.hub_center_m is not None:
        markers = np.concatenate([markers, layout.hub_center_m + lateral], axis=1)
    yaw, shift = rng.standard_normal((2, count))
    right = RightEyeErrors(np.radians(tolerances.right_yaw_deg) * yaw, tolerances.right_cx_px * shift)
    return TrueFeatures(markers, right)
