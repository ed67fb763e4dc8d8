"""What one eye sees of the flat drogue at one moment, as areas in its image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from drogue_models.parts import Part
from drogue_models.solids import area_radius_m
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig
from render.analytic_engine.flat_parts import FlatDrogue, FlatRing

# How far a polygon of the disc's area may stand from the circle: a pixel's coverage errs by as much.
_OUTLINE_ERROR_PX = 1e-4
_FEWEST_SIDES = 64


@dataclass(frozen=True, eq=False)
class EyeView:
    """One eye and where the drogue is for it.

    Attributes:
        rig, eye: which camera.
        left_from_drogue: pose of the drogue in the left camera.
    """

    rig: StereoRig
    eye: Eye
    left_from_drogue: RigidTransform

    def center_m(self, ring: FlatRing) -> Array:
        """(3,) centre of a ring in the eye's frame. [m]"""
        center: Array = self.left_from_drogue.apply(ring.center_m) - self.rig.eye_offset_m(self.eye)
        return center

    @property
    def sees_front(self) -> bool:
        """Whether the eye looks at the mouth; from behind the rim plane a flat drogue shows its dark back only."""
        origin = self.left_from_drogue.translation_m - self.rig.eye_offset_m(self.eye)
        return bool(origin @ self.left_from_drogue.rotation[:, 2] > 0)


def seen_areas(flat: FlatDrogue, view: EyeView) -> dict[int, Any]:
    """Areas to paint one over the other, by part id: shapely polygons in pixel coordinates.

    All of the front goes by the face's id. Coupling and hub are cut where the front hides them; the hub lies inside the
    coupling and the markers inside the front, whose areas have no holes for them.

    Raises:
        ValueError: part of the drogue is not in front of the camera.
    """
    front = shapely.union_all([_ring_area(ring, view) for ring in flat.front])
    if not view.sees_front:
        return {int(Part.FACE): front}
    areas = {ring.part: _hidden_by(front, _ring_area(ring, view)) for ring in flat.behind}
    areas[int(Part.FACE)] = front
    return areas | {ring.part: _ring_area(ring, view) for ring in flat.markers}


def _hidden_by(front: Any, area: Any) -> Any:
    return shapely.difference(area, front) if shapely.intersects(front, area) else area


def _ring_area(ring: FlatRing, view: EyeView) -> Any:
    holes = [_outline_px(ring, ring.inner_radius_m, view)] if ring.inner_radius_m > 0 else None
    return shapely.Polygon(_outline_px(ring, ring.outer_radius_m, view), holes)


def _outline_px(ring: FlatRing, radius_m: float, view: EyeView) -> Array:
    """(N, 2) corners of the image of a regular polygon with the disc's area. [px]

    A chord of one N-th of a circle of radius R falls short of it by `R pi^2 / (2 N^2)`, two thirds of that when the
    areas are equal.
    """
    nearest_m = view.center_m(ring)[2] - radius_m * np.hypot(*view.left_from_drogue.rotation[2, :2])
    if nearest_m <= 0:
        raise ValueError(f"left_from_drogue: all of the drogue must be in front of the camera, got {nearest_m:g} m")
    radius_px = max(view.rig.camera.fx_px, view.rig.camera.fy_px) * radius_m / nearest_m
    sides = max(int(np.ceil(np.pi * np.sqrt(radius_px / (3 * _OUTLINE_ERROR_PX)))), _FEWEST_SIDES)
    corners_m = disc_outline(view.left_from_drogue, ring.center_m, area_radius_m(radius_m, sides), sides)
    return view.rig.image(corners_m, view.eye)
