"""Positions of a drogue's features as arrays: all that pose estimators use of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drogue_models.bodies import BasketBody
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, read_only

# Markers in one plane have equal depths but for rounding errors.
_FLAT_TOLERANCE_M = 1e-6
# Positions over a marker's radius: what pictures can hardly tell, and more than rounding to millimetres changes markers
# of 5 cm radius.
_SYMMETRY_TOLERANCE = 0.03


@dataclass(frozen=True, eq=False)
class RimOutline:
    """What a drogue's outline against the background is made of.

    Attributes:
        radius_m: outermost radius of the rim's tube. [m]
        tube_radius_m: of the tube, whose circle lies as far behind the rim plane. [m]
        bulges_m: (K, 2) circles (radius, z) about the axis, within which all that is behind the rim lies. [m]
        is_known: whether nothing else reaches as far out as the rim.
    """

    radius_m: float
    tube_radius_m: float
    bulges_m: Array
    is_known: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "bulges_m", read_only(self.bulges_m, (-1, 2), "bulges_m"))


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
        rim: the outline, or None where unknown.
    """

    centers_m: Array
    radius_m: float
    hub_center_m: Array | None
    hub_inner_radius_m: float = 0.0
    hub_outer_radius_m: float = 0.0
    face_inner_radius_m: float = 0.0
    face_outer_radius_m: float = 0.0
    collar_radius_m: float = 0.0
    rim: RimOutline | None = None

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
        return self.count == 0 or bool(np.ptp(self.centers_m[:, 2]) < _FLAT_TOLERANCE_M)

    @cached_property
    def ring_radius_m(self) -> float | None:
        """Radius of the circle in the rim plane around the origin on which all markers lie, or None. [m]

        Their distances from the origin may differ by 3 % of a marker's radius; this is the mean.
        """
        radii = np.hypot(self.centers_m[:, 0], self.centers_m[:, 1])
        if self.count == 0 or np.abs(self.centers_m[:, 2]).max() > _FLAT_TOLERANCE_M:
            return None
        return float(radii.mean()) if np.ptp(radii) < self.tolerance_m else None

    @property
    def tolerance_m(self) -> float:
        """How far markers may be from where a symmetry puts them. [m]"""
        return _SYMMETRY_TOLERANCE * self.radius_m

    @cached_property
    def symmetry_order(self) -> int:
        """Number of rotations about the axis that map the markers onto themselves (8 for an even ring of 8).

        They may miss by 3 % of a marker's radius, so that a ring of rounded positions counts as the even one it is
        meant to be: pictures tell its turns apart by chance only.
        """
        for order in range(self.count, 1, -1):
            angle = 2 * np.pi / order
            turn = np.array(
                [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
            )
            turned = self.centers_m @ turn.T
            gaps = np.linalg.norm(turned[:, None] - self.centers_m[None], axis=-1).min(axis=1)
            if gaps.max() < self.tolerance_m:
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
        _rim_outline(drogue),
    )


def _rim_outline(drogue: DrogueParameters) -> RimOutline:
    body = drogue.body
    # A user's mesh may reach anywhere, and an inflated tube around the mouth is wider than the rim behind it.
    is_known = drogue.body_mesh is None and not (isinstance(body, BasketBody) and body.canopy.style == "tube")
    bulges_m = np.array(drogue.bulges_m).reshape(-1, 2)
    return RimOutline(drogue.rim_radius_m, drogue.rim_tube_radius_m, bulges_m, is_known)
