"""The drogue as flat rings: their outlines in the image of each eye, and the light that they send to the camera.

The rim is the flat equator of its tube. The tube's own outline lies nearer to the cameras, so near poses from the rim's
edge are off on these images: see `joint-rim` in docs/reference/methods.md.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from datasets_manifest.types.frame import FrameSpec
from drogue_models.drogue_families.fittings import FACE_THICKNESS_M
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part, marker_id
from drogue_models.solids import area_radius_m
from geometry.circles import disc_outline
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig
from render.analytic_engine.pixel_coverage import image_area
from render.surfaces import lamp_radiance_rgb, mean_reflectance_rgb
from scenes.environment_radiance import EnvironmentRadiance

# Largest distance between the circle and a polygon of equal area: the error of a pixel's coverage is no larger.
_OUTLINE_ERROR_PX = 1e-4
_FEWEST_SIDES = 64


@dataclass(frozen=True)
class FlatRing:
    """A disc, or a disc with a hole, across the drogue's axis.

    Attributes:
        part: its part id.
        center_m: in the drogue frame. [m]
        outer_radius_m, inner_radius_m: its edges; 0 inside for a disc. [m]
    """

    part: int
    center_m: tuple[float, float, float]
    outer_radius_m: float
    inner_radius_m: float = 0.0


@dataclass(frozen=True)
class FlatDrogue:
    """The rings that the analytic engine draws of a drogue.

    Attributes:
        behind: coupling and hub, behind the opening.
        front: rim and face, which hide what lies behind them. The rim's torus is drawn as the ring of its equator. The
            face is drawn at its back and at its front, so that its thickness hides what it should.
        markers: on the face.
    """

    behind: tuple[FlatRing, ...]
    front: tuple[FlatRing, ...]
    markers: tuple[FlatRing, ...]

    @property
    def back_to_front(self) -> tuple[FlatRing, ...]:
        """All rings; later ones hide earlier ones."""
        return self.behind + self.front + self.markers


def flat_drogue(drogue: DrogueParameters, gone: Collection[int] = ()) -> FlatDrogue:
    """The flat rings of a drogue with its dimensions, less the markers and the hub whose part ids are `gone`."""
    depth_m, tube_m = drogue.hub_depth_m, drogue.rim_tube_radius_m
    behind = [FlatRing(int(Part.COUPLING), (0.0, 0.0, depth_m), drogue.coupling_radius_m)]
    if drogue.hub is not None and int(Part.HUB) not in gone:
        hub = drogue.hub
        behind.append(FlatRing(int(Part.HUB), (0.0, 0.0, depth_m), hub.outer_radius_m, hub.inner_radius_m))
    opening_m, face_outer_m = drogue.face_inner_radius_m, drogue.rim_radius_m - tube_m
    front = [
        FlatRing(int(Part.FACE), (0.0, 0.0, FACE_THICKNESS_M), face_outer_m, opening_m),
        FlatRing(int(Part.RIM), (0.0, 0.0, tube_m), drogue.rim_radius_m, face_outer_m - tube_m),
        FlatRing(int(Part.FACE), (0.0, 0.0, 0.0), face_outer_m, opening_m),
    ]
    markers = [
        FlatRing(marker_id(index), (x, y, 0.0), drogue.marker_radius_m)
        for index, (x, y) in enumerate(drogue.marker_positions_m)
        if marker_id(index) not in gone
    ]
    return FlatDrogue(tuple(behind), tuple(front), tuple(markers))


def ring_radiance(frame: FrameSpec, ambient: EnvironmentRadiance, rings: tuple[FlatRing, ...]) -> dict[int, Array]:
    """Radiance of each ring at the camera, the same all over it.

    Every ring receives the light of the open rim plane, `L = reflectance E / pi`; lamps add their own. The air
    attenuates it over the distance to the ring's centre and adds airlight. Rings with one part id stand for one part;
    the last one counts.

    Returns:
        (3,) luminance-scaled linear Rec. 709 by part id. [cd/m2]
    """
    pose = frame.left_from_drogue
    assert pose is not None
    plate = FlatSurfaceLight(frame, ambient, pose)
    return {
        ring.part: plate.radiance(
            mean_reflectance_rgb(frame, ring.part), lamp_radiance_rgb(frame, ring.part), pose.apply(ring.center_m)[2]
        )
        for ring in rings
    }


class FlatSurfaceLight:
    """Light on a flat surface that faces the camera, and its radiance behind the air."""

    def __init__(self, frame: FrameSpec, ambient: EnvironmentRadiance, pose: RigidTransform) -> None:
        """Compute the light on a plate across the z axis of a pose in the left camera; either side may face it."""
        towards_camera = -np.sign(pose.translation_m @ pose.rotation[:, 2]) * pose.rotation[:, 2]
        self._illuminance_lux = ambient.plate_illuminance_lux(frame.world_from_left.rotate(towards_camera))
        towards_plate = pose.translation_m / np.linalg.norm(pose.translation_m)
        self._air = ambient.airlight(frame.world_from_left.rotate(towards_plate)).astype(np.float64)
        self._extinction_per_depth = ambient.extinction_per_m / towards_plate[2]

    def radiance(self, reflectance_rgb: Array, lamp_cd_m2: Array | float, depth_m: float) -> Array:
        """(3,) radiance at the camera of a surface with a (3,) reflectance that may emit light too. [cd/m2]"""
        sent = reflectance_rgb * self._illuminance_lux / np.pi + lamp_cd_m2
        clear = np.exp(-self._extinction_per_depth * depth_m)
        radiance: Array = sent * clear + self._air * (1.0 - clear)
        return radiance


@dataclass(frozen=True, eq=False)
class EyeView:
    """One eye and the pose of the drogue.

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
        """Whether the eye looks into the mouth; from behind the rim plane a flat drogue shows only its dark back."""
        origin = self.left_from_drogue.translation_m - self.rig.eye_offset_m(self.eye)
        return bool(origin @ self.left_from_drogue.rotation[:, 2] > 0)


def visible_areas(flat: FlatDrogue, view: EyeView) -> dict[int, Any]:
    """Areas to paint one over another, by part id: shapely polygons in pixel coordinates.

    The whole front has the face's id. Coupling and hub are clipped where the front hides them. The hub lies inside the
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
    hole_m = _outline_m(ring, ring.inner_radius_m, view) if ring.inner_radius_m > 0 else None
    return image_area(view.rig, view.eye, _outline_m(ring, ring.outer_radius_m, view), hole_m)


def _outline_m(ring: FlatRing, radius_m: float, view: EyeView) -> Array:
    """(N, 3) corners of a regular polygon with the disc's area, in the left camera. [m]

    A chord over one N-th of a circle of radius R deviates from it by `R pi^2 / (2 N^2)`, and by two thirds of that when
    the areas are equal.
    """
    nearest_m = view.center_m(ring)[2] - radius_m * np.hypot(*view.left_from_drogue.rotation[2, :2])
    if nearest_m <= 0:
        raise ValueError(f"left_from_drogue: all of the drogue must be in front of the camera, got {nearest_m:g} m")
    radius_px = max(view.rig.camera.fx_px, view.rig.camera.fy_px) * radius_m / nearest_m
    sides = max(int(np.ceil(np.pi * np.sqrt(radius_px / (3 * _OUTLINE_ERROR_PX)))), _FEWEST_SIDES)
    return disc_outline(view.left_from_drogue, ring.center_m, area_radius_m(radius_m, sides), sides)
