"""Positions of a drogue's features as arrays: all that pose estimators use of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, read_only

# Tolerance of an even ring of markers, far below the accuracy of any centroid.
_RING_TOLERANCE_M = 1e-6


@dataclass(frozen=True, eq=False)
class MarkerLayout:
    """Centres and radii of the markers and the hub in the drogue frame.

    Attributes:
        centers_m: (N, 3) marker centres; N may be 0. [m]
        radius_m: radius of every marker. [m]
        hub_center_m: (3,) centre of the hub annulus, or None. [m]
        hub_inner_radius_m, hub_outer_radius_m: its edges, 0 without a hub. [m]
        face_inner_radius_m, face_outer_radius_m: edges of the dark face around the markers, 0 without one. [m]
        collar_radius_m: outer edge of the coupling around the hub, 0 where unknown. [m]
    """

    centers_m: Array
    radius_m: float
    hub_center_m: Array | None
    hub_inner_radius_m: float = 0.0
    hub_outer_radius_m: float = 0.0
    face_inner_radius_m: float = 0.0
    face_outer_radius_m: float = 0.0
    collar_radius_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "centers_m", read_only(self.centers_m, (-1, 3), "centers_m"))
        if self.hub_center_m is not None:
            object.__setattr__(self, "hub_center_m", read_only(self.hub_center_m, (3,), "hub_center_m"))

    @cached_property
    def count(self) -> int:
        """Number of markers."""
        return int(self.centers_m.shape[0])

    @cached_property
    def is_flat(self) -> bool:
        """Whether all markers have the same depth."""
        return self.count == 0 or bool(np.ptp(self.centers_m[:, 2]) < _RING_TOLERANCE_M)

    @cached_property
    def ring_radius_m(self) -> float | None:
        """Radius of the circle in the rim plane around the origin on which all markers lie, or None. [m]"""
        radii = np.hypot(self.centers_m[:, 0], self.centers_m[:, 1])
        if self.count == 0 or np.abs(self.centers_m[:, 2]).max() > _RING_TOLERANCE_M:
            return None
        return float(radii.mean()) if np.ptp(radii) < _RING_TOLERANCE_M else None

    @cached_property
    def symmetry_order(self) -> int:
        """Number of rotations about the axis that map the markers onto themselves (8 for an even ring of 8)."""
        for order in range(self.count, 1, -1):
            angle = 2 * np.pi / order
            turn = np.array(
                [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
            )
            turned = self.centers_m @ turn.T
            gaps = np.linalg.norm(turned[:, None] - self.centers_m[None], axis=-1).min(axis=1)
            if gaps.max() < _RING_TOLERANCE_M:
                return order
        return 1


def marker_layout(drogue: DrogueParameters) -> MarkerLayout:
    """The features of a drogue."""
    hub, has_face = drogue.hub, drogue.body is None
    return MarkerLayout(
        np.array(drogue.marker_centers_m).reshape(-1, 3),
        drogue.marker_radius_m,
        None if hub is None else np.array([0.0, 0.0, hub.depth_m]),
        0.0 if hub is None else hub.inner_radius_m,
        0.0 if hub is None else hub.outer_radius_m,
        drogue.face_inner_radius_m if has_face else 0.0,
        drogue.rim_radius_m if has_face else 0.0,
        drogue.coupling_radius_m,
    )
