"""Sampling a second hose and drogue: behind another station of the tanker, or behind a second tanker beside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.aircraft_ranges import HoseRanges, NeighbourRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.types.appearance import DrogueCondition
from datasets_manifest.types.frame import OtherDrogue
from drogue_models.parameters import DrogueParameters
from drogue_models.tankers.tanker import Tanker
from drogue_models.tankers.tanker_surfaces import airframe_size_m
from drogue_models.tankers.wing_with_pod import pod_exit_m
from geometry.se3 import Array, RigidTransform
from scenes.environment_sampling import sample_uniform
from scenes.flight.suspension import (
    SceneHose,
    hose_look_of_scene,
    hose_of_scene,
    hose_tail_m,
    straight_hose_nodes_m,
)
from scenes.flight.towed_hose import HoseEnds, hose_at_rest
from scenes.flight.trajectory import FrameKinematics
from scenes.framing import sample_point_in_view

_TRIES = 30
# Own draws of the second hose in a scene come from a scene index that no other hose has.
_SECOND_HOSE = 1 << 40


@dataclass(frozen=True)
class NeighbourKind:
    """What the drogues of a frame have in common.

    Attributes:
        drogue: of the scene.
        condition: of its surfaces.
        tanker: of the scene, or None for the wing with one pod.
    """

    drogue: DrogueParameters
    condition: DrogueCondition | None
    tanker: Tanker | None


def neighbours_of_frame(
    recipe: Recipe,
    scene_id: int,
    frame_index: int,
    kinematics: FrameKinematics,
    kind: NeighbourKind,
) -> tuple[OtherDrogue, ...]:
    """The second drogue of a frame, or none.

    Args:
        recipe: as it holds for the frame's scene.
        scene_id: which scene.
        frame_index: of the frame.
        kinematics: of the frame.
        kind: what the second drogue has in common with the first one.
    """
    ranges, drogue = recipe.neighbours, kind.drogue
    if ranges is None or kinematics.left_from_drogue is None or kinematics.left_from_tanker is None:
        return ()
    # A multirotor flies alone.
    if kind.tanker is not None and kind.tanker.type == "multirotor":
        return ()
    if frame_generator(recipe.stream_seed, scene_id, "neighbours").random() >= ranges.scene_fraction:
        return ()
    hoses = recipe.hose or HoseRanges()
    hose = hose_of_scene(recipe.stream_seed, _SECOND_HOSE + scene_id, hoses, drogue)
    rng = frame_generator(recipe.stream_seed, frame_index, "neighbour")
    first = _Formation(recipe, kinematics.left_from_drogue, kinematics.left_from_tanker, kind)
    # Only under the plain wing is there room for another pod.
    is_same = rng.random() < ranges.same_tanker_fraction and kind.tanker is None
    hanging = _hung(rng, hoses, hose, drogue)
    placed = first.at_other_station(rng, ranges, hanging) if is_same else None
    second_tanker = None
    if placed is None:
        placed, second_tanker = first.behind_second_tanker(rng, ranges, hanging)
        if placed is None:
            return ()
    left_from_exit, tanker_from_drogue, nodes_m = placed, *hanging
    other = OtherDrogue(
        drogue=drogue,
        condition=kind.condition,
        left_from_drogue=left_from_exit @ tanker_from_drogue,
        hose_nodes_left_m=left_from_exit.apply(nodes_m),
        hose_look=None if recipe.hose is None else hose_look_of_scene(recipe.stream_seed, scene_id, recipe.hose),
        left_from_tanker=second_tanker,
    )
    return (other,)


def _hung(
    rng: np.random.Generator, ranges: HoseRanges, hose: SceneHose, drogue: DrogueParameters
) -> tuple[RigidTransform, Array]:
    """Pose of a drogue behind an exit, in axes of the tanker with that exit as origin, and (K, 3) nodes of its hose.

    The drogue points along the end of its hose, which air and weight alone bend. [m]
    """
    drop_rad, swing_rad = (float(np.radians(sample_uniform(rng, part))) for part in (ranges.drop_deg, ranges.swing_deg))
    roll = rng.uniform(0.0, 2 * np.pi)
    if hose.retracted:
        nodes = straight_hose_nodes_m(hose.parameters.length_m)
    else:
        nodes = hose_at_rest(
            hose.parameters, HoseEnds(0.0, -0.7 * drop_rad, drop_rad, swing_rad), ranges.airspeed_m_s
        ).nodes_m
    along = nodes[-1] - nodes[-2]
    z = -along / np.linalg.norm(along)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    upright = np.column_stack([x, np.cross(z, x), z])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    rotation = upright @ turn
    pose = RigidTransform(rotation, nodes[-1] - rotation[:, 2] * hose_tail_m(drogue))
    return pose, nodes[::-1].copy()


class _Formation:
    """Where a second drogue may be, relative to the first."""

    def __init__(
        self,
        recipe: Recipe,
        left_from_drogue: RigidTransform,
        left_from_tanker: RigidTransform,
        kind: NeighbourKind,
    ) -> None:
        self._rig, self._drogue = recipe.rig, kind.drogue
        self._sought, self._tanker = left_from_drogue, left_from_tanker
        self._airframe_m = None if kind.tanker is None else airframe_size_m(kind.tanker)

    def at_other_station(
        self, rng: np.random.Generator, ranges: NeighbourRanges, hanging: tuple[RigidTransform, Array]
    ) -> RigidTransform | None:
        """`left_from_exit` at another station of the first tanker, or None where the drogue would not be in view."""
        for _ in range(_TRIES):
            away_m, outboard = sample_uniform(rng, ranges.station_m), rng.random() < 0.5
            try:
                exit_m = pod_exit_m(-away_m if outboard else away_m)
            except ValueError:
                continue
            left_from_exit: RigidTransform = self._tanker @ RigidTransform(np.eye(3), exit_m)
            if self._fits((left_from_exit @ hanging[0]).translation_m, ranges):
                return left_from_exit
        return None

    def behind_second_tanker(
        self, rng: np.random.Generator, ranges: NeighbourRanges, hanging: tuple[RigidTransform, Array]
    ) -> tuple[RigidTransform | None, RigidTransform | None]:
        """`left_from_exit` and the second tanker's pose, which is the same; None where no place is found."""
        for _ in range(_TRIES):
            depth_m = sample_uniform(rng, ranges.distance_fraction) * float(self._sought.translation_m[2])
            place_m = sample_point_in_view(rng, self._rig, depth_m)
            exit_m = place_m - self._tanker.rotation @ hanging[0].translation_m
            if self._fits(place_m, ranges) and self._is_clear(exit_m):
                pose = RigidTransform(self._tanker.rotation, exit_m)
                return pose, pose
        return None, None

    def _is_clear(self, exit_m: Array) -> bool:
        """Whether a second airframe of the same heading there has a box that is clear of the first one's."""
        if self._airframe_m is None:
            return True
        away_m = self._tanker.rotation.T @ (exit_m - self._tanker.translation_m)
        return bool((np.abs(away_m) > self._airframe_m).any())

    def _fits(self, place_m: Array, ranges: NeighbourRanges) -> bool:
        """Whether both eyes see all of a drogue there, and none of it behind the sought one."""
        nearest_m = ranges.distance_fraction.low * self._sought.translation_m[2]
        if place_m[2] < nearest_m:
            return False
        rig, radius_m = self._rig, self._drogue.rim_radius_m
        field = rig.common_field_m(float(place_m[2]), radius_m)
        if field is None or not (field[0] <= place_m[0] <= field[1] and field[2] <= place_m[1] <= field[3]):
            return False
        for eye_m in (0.0, rig.baseline_m):
            here, there = ((place[:2] - [eye_m, 0.0]) / place[2] for place in (place_m, self._sought.translation_m))
            apart = radius_m / place_m[2] + radius_m / self._sought.translation_m[2]
            if np.linalg.norm(here - there) < 1.1 * apart:
                return False
        return True
