"""The drogue reduced to flat rings across its axis, and the light that each sends to the camera."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import FACE_THICKNESS_M
from drogue_models.parameters import DrogueParameters
from drogue_models.parts import Part, marker_id
from geometry.se3 import Array, RigidTransform
from render.surfaces import lamp_radiance_rgb, mean_reflectance_rgb
from scenes.environment_radiance import Surroundings


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
    """What the analytic engine draws of a drogue.

    Attributes:
        behind: coupling and hub, behind the opening.
        front: rim and face, which hide what lies behind them. The rim's torus is the ring of its equator. The face is
            drawn at its back and at its front: what is seen through both is what its thickness lets through.
        markers: on the face.
    """

    behind: tuple[FlatRing, ...]
    front: tuple[FlatRing, ...]
    markers: tuple[FlatRing, ...]

    @property
    def back_to_front(self) -> tuple[FlatRing, ...]:
        """All rings; a later one hides an earlier one."""
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


def ring_radiance(frame: FrameSpec, around: Surroundings, rings: tuple[FlatRing, ...]) -> dict[int, Array]:
    """Radiance of each ring at the camera, the same all over it.

    Light falls on every ring as on the open rim plane, `L = reflectance E / pi`, lamps add their own, and the air takes
    its share over the way to the ring's centre and adds its own. Rings with one part id stand for one
    part; the last one counts.

    Returns:
        (3,) luminance-scaled linear Rec. 709 by part id. [cd/m2]
    """
    pose = frame.left_from_drogue
    assert pose is not None
    plate = PlateLight(frame, around, pose)
    return {
        ring.part: plate.seen(
            mean_reflectance_rgb(frame, ring.part), lamp_radiance_rgb(frame, ring.part), pose.apply(ring.center_m)[2]
        )
        for ring in rings
    }


class PlateLight:
    """Light on a flat thing that faces the camera, and what the air leaves of what it sends back."""

    def __init__(self, frame: FrameSpec, around: Surroundings, pose: RigidTransform) -> None:
        """Light on a plate whose pose in the left camera has its axis along z; either side may face the camera."""
        towards_camera = -np.sign(pose.translation_m @ pose.rotation[:, 2]) * pose.rotation[:, 2]
        self._illuminance_lux = around.plate_illuminance_lux(frame.world_from_left.rotate(towards_camera))
        towards_plate = pose.translation_m / np.linalg.norm(pose.translation_m)
        self._air = around.airlight(frame.world_from_left.rotate(towards_plate)).astype(np.float64)
        self._extinction_per_depth = around.extinction_per_m / towards_plate[2]

    def seen(self, reflectance_rgb: Array, lamp_cd_m2: Array | float, depth_m: float) -> Array:
        """(3,) radiance at the camera of a surface with a (3,) reflectance and light of its own. [cd/m2]"""
        sent = reflectance_rgb * self._illuminance_lux / np.pi + lamp_cd_m2
        clear = np.exp(-self._extinction_per_depth * depth_m)
        radiance: Array = sent * clear + self._air * (1.0 - clear)
        return radiance
