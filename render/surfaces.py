"""All surfaces of a frame: where they are, and what they reflect and emit with their ageing, dirt and lamps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.appearance import AS_NEW, Obstacle, SurfaceCondition
from datasets_manifest.types.frame import FrameSpec
from drogue_models.drogue_surfaces import drogue_surfaces
from drogue_models.obstacles import ObstacleShape
from drogue_models.painted_mesh import PaintedMesh
from drogue_models.parts import (
    FIRST_MARKER_ID,
    INSTANCE_STEP,
    SURROUNDING_PARTS,
    TANKER_GREY,
    Part,
    part_reflectance_rgb,
)
from drogue_models.surroundings.bystanders import bystander_surface
from drogue_models.surroundings.hose_surface import hose_surface
from drogue_models.tankers.tanker_surfaces import tanker_surfaces
from drogue_models.tankers.wing_with_pod import POD_LENGTH_M, POD_RADIUS_M, wing_surfaces
from geometry.se3 import Array, RigidTransform
from scenes.sky.photometry import REC709_LUMINANCE

DIRT_MAP_PX = 64
# How groups of surfaces of drogues beside the sought one begin.
NEIGHBOUR_GROUP = "neighbour_drogue_"
# A second pod beside that of the wing in view, and columns of its axes (left, up, forward) in the tanker's.
_POD = ObstacleShape(form="pod", radius_m=POD_RADIUS_M, length_m=POD_LENGTH_M, seed=1)
_TANKER_FROM_POD = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
# Soot, hydraulic fluid and road dust: dark and nearly grey (our choice).
DIRT_RGB = (0.055, 0.050, 0.045)
_BLOTCH_PX = 5.0
_EDGE_PX = 1.2
# A map with more contrast has edges that a pixel's few rays may miss.
_EVEN_CONTRAST = 0.2


@dataclass(frozen=True, eq=False)
class Surface:
    """One surface of a frame.

    Attributes:
        part_id: `drogue_models.parts`.
        group: equal for all surfaces of one thing, such as the tanker.
        painted: its mesh, texture coordinates and sheen.
        axes_from_mesh: where the mesh is in the axes that were asked for.
        reflectance: (3,) or (h, w, 3), the paint in its condition in this frame.
        emission_cd_m2: (3,) emitted radiance. [cd/m2]
        is_lamp: it may shine in another condition of the same drogue.
        lights_others: whether paths from other surfaces find it. A lamp of a few centimetres would leave speckles.
        is_dirty: dirt lies on the paint.
    """

    part_id: int
    group: str
    painted: PaintedMesh
    axes_from_mesh: RigidTransform
    reflectance: NDArray[np.floating[Any]]
    emission_cd_m2: Array
    is_lamp: bool
    lights_others: bool
    is_dirty: bool = False

    @property
    def uv(self) -> Array | None:
        """(V, 2) texture coordinates if the reflectance is a map."""
        return self.painted.uv if self.reflectance.ndim == 3 else None

    @property
    def kind(self) -> tuple[object, ...]:
        """Equal for surfaces that can take each other's places in a loaded scene, given new vertices and paint."""
        map_size = self.reflectance.shape[:-1]
        look = self.painted.smooth, self.painted.sheen, map_size, self.is_lamp, self.lights_others
        return (self.part_id, self.painted.topology, *look)

    def hull_m(self) -> Array:
        """(N, 3) points whose convex hull holds the surface, in the axes that were asked for. [m]"""
        mesh = self.painted.mesh
        # The box around a curved hose would hold much more than the hose.
        points = mesh.vertices if self.part_id % INSTANCE_STEP == Part.HOSE else trimesh.bounds.corners(mesh.bounds)
        hull: Array = self.axes_from_mesh.apply(np.asarray(points))
        return hull


@dataclass(frozen=True, eq=False)
class FrameSurfaces:
    """All surfaces of a frame by name.

    Attributes:
        fixed: the drogue's parts that have not come off, in the drogue frame.
        moved: hose, tanker and bystanders.
    """

    fixed: dict[str, Surface]
    moved: dict[str, Surface]

    @property
    def all(self) -> dict[str, Surface]:
        """Fixed and moved surfaces."""
        return self.fixed | self.moved

    @property
    def uneven_parts(self) -> set[int]:
        """Part ids of the drogue's surfaces whose paint has edges of its own."""
        return {surface.part_id for surface in self.fixed.values() if _is_uneven(surface)}


def _is_uneven(surface: Surface) -> bool:
    return surface.is_dirty or (surface.painted.has_map and surface.painted.contrast > _EVEN_CONTRAST)


def frame_surfaces(frame: FrameSpec, axes_from_left: RigidTransform) -> FrameSurfaces:
    """All surfaces of a frame at mid-exposure.

    Args:
        frame: what it shows.
        axes_from_left: axes in which the moved surfaces are given.

    Raises:
        ValueError: the user's body mesh is missing, changed, or not fit for use.
    """
    moved: dict[str, Surface] = {}
    if frame.drogue is not None and frame.hose_nodes_left_m is not None:
        hose = hose_surface(frame.drogue, axes_from_left.apply(frame.hose_nodes_left_m), frame.hose_look)
        moved |= _named([hose], Part.HOSE, RigidTransform.identity(), _worn_fraction(frame, Part.HOSE))
    if frame.left_from_tanker is not None:
        moved |= _named(frame_tanker_surfaces(frame), Part.TANKER, axes_from_left @ frame.left_from_tanker)
    for index, obstacle in enumerate(frame.bystanders):
        part = Part[obstacle.kind.upper()]
        name = f"part_{int(part)}_{index}"
        pose = axes_from_left @ obstacle.left_from_object
        moved[name] = _surface(obstacle_surfaces(obstacle), int(part), name, pose)
    for instance, other in enumerate(frame.sought_and_neighbours()):
        if instance > 0:
            moved |= _neighbour_surfaces(other, instance, axes_from_left)
            if other.left_from_tanker is None:
                moved |= _second_pod(frame, other, instance, axes_from_left)
    return FrameSurfaces(fixed=_fixed_surfaces(frame), moved=moved)


def _second_pod(
    frame: FrameSpec, other: FrameSpec, instance: int, axes_from_left: RigidTransform
) -> dict[str, Surface]:
    """The pod of the tanker in view that a neighbour's hose comes from."""
    assert frame.left_from_tanker is not None and other.hose_nodes_left_m is not None
    left_from_pod = RigidTransform(frame.left_from_tanker.rotation @ _TANKER_FROM_POD, other.hose_nodes_left_m[-1])
    pod = bystander_surface(_POD, TANKER_GREY)
    name = f"part_{int(Part.TANKER)}_pod_{instance}"
    return {name: _surface(pod, int(Part.TANKER), name, axes_from_left @ left_from_pod)}


def _neighbour_surfaces(frame: FrameSpec, instance: int, axes_from_left: RigidTransform) -> dict[str, Surface]:
    """Drogue, hose and second tanker of a frame that has a neighbour as its drogue, with that neighbour's part ids."""
    assert frame.drogue is not None and frame.left_from_drogue is not None and frame.hose_nodes_left_m is not None
    axes_from_drogue = axes_from_left @ frame.left_from_drogue
    hose = hose_surface(frame.drogue, axes_from_left.apply(frame.hose_nodes_left_m), frame.hose_look)
    own = {int(Part.HOSE): _surface(hose, 0, "", RigidTransform.identity(), _worn_fraction(frame, Part.HOSE))}
    own |= {
        surface.part_id: replace(surface, axes_from_mesh=axes_from_drogue)
        for surface in _fixed_surfaces(frame).values()
    }
    found = {}
    for part, surface in own.items():
        part_id = INSTANCE_STEP * instance + part
        group = f"neighbour_hose_{instance}" if part == Part.HOSE else f"{NEIGHBOUR_GROUP}{instance}"
        found[f"part_{part_id}"] = replace(surface, part_id=part_id, group=group)
    if frame.left_from_tanker is not None:
        tanker = _named(frame_tanker_surfaces(frame), Part.TANKER, axes_from_left @ frame.left_from_tanker)
        found |= {
            f"{name}_of_{instance}": replace(surface, group=f"{surface.group}_of_{instance}")
            for name, surface in tanker.items()
        }
    return found


def shows_surfaces(frame: FrameSpec) -> bool:
    """Whether a frame has any surface to render."""
    return frame.drogue is not None or frame.left_from_tanker is not None or len(frame.bystanders) > 0


def frame_tanker_surfaces(frame: FrameSpec) -> tuple[PaintedMesh, ...]:
    """Surfaces of the frame's tanker in the tanker frame."""
    return wing_surfaces() if frame.tanker is None else tanker_surfaces(frame.tanker)


def obstacle_surfaces(obstacle: Obstacle) -> PaintedMesh:
    """The surface of a bystander in its own axes."""
    return bystander_surface(obstacle.shape, obstacle.reflectance_rgb, obstacle.luminance_cd_m2)


def _named(
    surfaces: Iterable[PaintedMesh], part: Part, pose: RigidTransform, fraction: float = 1.0
) -> dict[str, Surface]:
    """Surfaces of one thing by name; `fraction` is a factor on their reflectance."""
    group = f"part_{int(part)}"
    named = {}
    for index, painted in enumerate(surfaces):
        name = group if index == 0 else f"{group}_{index}"
        named[name] = _surface(painted, int(part), group, pose, fraction)
    return named


def _surface(painted: PaintedMesh, part_id: int, group: str, pose: RigidTransform, fraction: float = 1.0) -> Surface:
    return Surface(
        part_id=part_id,
        group=group,
        painted=painted,
        axes_from_mesh=pose,
        reflectance=_scaled(painted.reflectance, fraction),
        emission_cd_m2=painted.emission_cd_m2,
        is_lamp=bool(painted.emission_cd_m2.any()),
        lights_others=False,
    )


def _fixed_surfaces(frame: FrameSpec) -> dict[str, Surface]:
    if frame.drogue is None:
        return {}
    wear = None if frame.condition is None else frame.condition.wear
    gone, found = missing_parts(frame), {}
    for part, painted in drogue_surfaces(frame.drogue, wear).items():
        if part not in gone:
            lamp = part >= FIRST_MARKER_ID and frame.drogue.marker_luminance_cd_m2 > 0
            surface = _surface(painted, part, "drogue", RigidTransform.identity())
            found[f"part_{part}"] = replace(
                surface,
                reflectance=_in_condition(frame, part, painted.reflectance),
                emission_cd_m2=lamp_radiance_rgb(frame, part) if lamp else painted.emission_cd_m2,
                is_lamp=lamp or surface.is_lamp,
                lights_others=lamp,
                is_dirty=is_feature(part) and not surface_condition(frame, part).is_clean,
            )
    return found


def feature_surfaces(fixed: dict[str, Surface]) -> dict[str, trimesh.Trimesh]:
    """Visible faces of markers and hub by name; their side walls are sunk in the part around them."""
    return {name: front_faces(surface.painted.mesh) for name, surface in fixed.items() if is_feature(surface.part_id)}


def is_feature(part_id: int) -> bool:
    """Whether a part is a marker or the hub."""
    return part_id == Part.HUB or part_id >= FIRST_MARKER_ID


def front_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The front of a flat feature."""
    return mesh.submesh([np.flatnonzero(mesh.face_normals[:, 2] < -0.5)], append=True)


def _scaled(reflectance: NDArray[np.floating[Any]], fraction: float) -> NDArray[np.floating[Any]]:
    return reflectance if fraction == 1.0 else np.minimum(reflectance * fraction, 1.0)


def _worn_fraction(frame: FrameSpec, part_id: int) -> float:
    """Factor on the reflectance of a part other than the markers and the hub."""
    worn = frame.condition is not None and (part_id == Part.HOSE or part_id not in SURROUNDING_PARTS)
    return frame.condition.body_reflectance_fraction if worn and frame.condition is not None else 1.0


def _in_condition(frame: FrameSpec, part_id: int, paint: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Paint of a part of the drogue as the condition of this frame leaves it."""
    if not is_feature(part_id):
        return _scaled(paint, _worn_fraction(frame, part_id))
    condition = surface_condition(frame, part_id)
    faded = _scaled(paint, condition.reflectance_fraction)
    return faded if condition.is_clean else _under_dirt(faded, condition)


def _under_dirt(paint: NDArray[np.floating[Any]], condition: SurfaceCondition) -> NDArray[np.float32]:
    """(h, w, 3) paint with dirt over the square around a marker or the hub; row 0 is the low y end."""
    dirt = dirt_map(condition.dirt_seed, condition.dirt_fraction)
    if paint.ndim == 3 and paint.shape[:2] != dirt.shape:
        dirt = cv2.resize(dirt, (paint.shape[1], paint.shape[0]), interpolation=cv2.INTER_LINEAR)
    share = dirt[..., None]
    result: NDArray[np.float32] = (paint * (1.0 - share) + np.array(DIRT_RGB) * share).astype(np.float32)
    return result


def surface_condition(frame: FrameSpec, part_id: int) -> SurfaceCondition:
    """State of a marker or the hub; all other parts age together, see `clean_reflectance_rgb`."""
    if frame.condition is None:
        return AS_NEW
    if part_id == Part.HUB:
        return frame.condition.hub
    return frame.condition.of_marker(part_id - FIRST_MARKER_ID) if part_id >= FIRST_MARKER_ID else AS_NEW


def clean_reflectance_rgb(frame: FrameSpec, part_id: int) -> NDArray[np.float64]:
    """(3,) diffuse reflectance of a part of the drogue, the hose or the tanker, without its dirt and wear.

    Raises:
        ValueError: the frame has no such part.
    """
    if frame.drogue is None:
        raise ValueError("drogue: the frame has none")
    paint = np.array(part_reflectance_rgb(frame.drogue, part_id))
    if is_feature(part_id):
        return paint * surface_condition(frame, part_id).reflectance_fraction
    clean: NDArray[np.float64] = np.minimum(paint * _worn_fraction(frame, part_id), 1.0)
    return clean


def mean_reflectance_rgb(frame: FrameSpec, part_id: int) -> NDArray[np.float64]:
    """(3,) diffuse reflectance of a part, with its dirt spread evenly."""
    dirt = surface_condition(frame, part_id).dirt_fraction
    mean: NDArray[np.float64] = clean_reflectance_rgb(frame, part_id) * (1.0 - dirt) + np.array(DIRT_RGB) * dirt
    return mean


def lamp_radiance_rgb(frame: FrameSpec, part_id: int) -> NDArray[np.float64]:
    """(3,) radiance that a marker emits, 0 for all other parts. [cd/m2]"""
    if frame.drogue is None or part_id < FIRST_MARKER_ID or frame.drogue.marker_luminance_cd_m2 == 0:
        return np.zeros(3)
    color = np.array(frame.drogue.marker_emission_rgb)
    luminance = frame.drogue.marker_luminance_cd_m2 * surface_condition(frame, part_id).lamp_fraction
    radiance: NDArray[np.float64] = luminance * color / (color @ REC709_LUMINANCE)
    return radiance


def missing_parts(frame: FrameSpec) -> set[int]:
    """Part ids of the markers, and possibly the hub, that have come off."""
    return {part for part in _features(frame) if surface_condition(frame, part).missing}


def _features(frame: FrameSpec) -> list[int]:
    """Part ids of hub and markers of a drogue whose condition is not as new."""
    if frame.drogue is None or frame.condition is None:
        return []
    return [int(Part.HUB), *range(FIRST_MARKER_ID, FIRST_MARKER_ID + frame.drogue.marker_count)]


@lru_cache(maxsize=64)
def dirt_map(seed: int, dirt_fraction: float) -> NDArray[np.float32]:
    """Where dirt covers the square around a disc.

    Args:
        seed: of the pattern.
        dirt_fraction: share of the square that is covered.

    Returns:
        (64, 64) share of each texel under dirt, 0 to 1; row 0 is the low y end of the square.
    """
    noise = frame_generator(seed, 0, "dirt").standard_normal((DIRT_MAP_PX, DIRT_MAP_PX))
    smooth = gaussian_filter(noise, _BLOTCH_PX, mode="wrap")
    covered = (smooth >= np.quantile(smooth, 1.0 - dirt_fraction)).astype(np.float64)
    if dirt_fraction <= 0:
        covered[:] = 0.0
    softened: NDArray[np.float32] = gaussian_filter(covered, _EDGE_PX, mode="wrap").astype(np.float32)
    softened.flags.writeable = False
    return softened
