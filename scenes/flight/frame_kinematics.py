"""Poses and motion at the time of one stereo pair; for a single pair also the hose and the tanker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import DropoutKind
from drogue_models.parameters import DrogueParameters
from geometry.se3 import Array, RigidTransform

HOSE_NODES = 17
# Position of the drogue behind and below the pod: equilibrium of a 15 m hose at 120 m/s in a lumped-mass model.
_TRAIL_AFT_M, _TRAIL_BELOW_M = 14.2, 4.9
_LATERAL_SPREAD_M = 0.6
# The hose leaves the pod nearly level and steepens towards the drogue.
_SLOPE_AT_POD = 0.2
# Length of hose inside the coupling's tail, so that no gap shows.
HOSE_OVERLAP_M = 0.02
# World axes of a tanker that flies east: aft, right wing, up.
WORLD_FROM_TANKER = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class FrameKinematics:
    """Poses and motion of one pair; fields as in `FrameSpec`.

    Attributes:
        sequence_id: its sequence, or None for a single pair.
        time_s: mid-exposure. [s]
        left_from_drogue, left_from_tanker: poses, or None without a drogue.
        world_from_left: pose.
        camera_offset_m: east and north, as in `Environment`. [m]
        left_twist_per_s, drogue_twist_per_s: (6,) body twists. [m/s, rad/s]
        hose_nodes_left_m: (K, 3) from the coupling to the pod, or None without a drogue. [m]
        loss: as in `FrameSpec`.
        obstacle: a bar in front of the cameras, or None.
        sun_deg: elevation and azimuth of the sun if they differ from the scene's, or None. [deg]
    """

    sequence_id: int | None
    time_s: float
    left_from_drogue: RigidTransform | None
    world_from_left: RigidTransform
    left_from_tanker: RigidTransform | None
    left_twist_per_s: Array
    drogue_twist_per_s: Array
    hose_nodes_left_m: Array | None
    camera_offset_m: tuple[float, float] = (0.0, 0.0)
    loss: DropoutKind | None = None
    obstacle: Obstacle | None = None
    sun_deg: tuple[float, float] | None = None


def sample_suspension(
    rng: np.random.Generator,
    drogue: DrogueParameters,
    left_from_drogue: RigidTransform,
    world_from_left: RigidTransform,
) -> tuple[RigidTransform, Array]:
    """Tanker pose and centre line of the hose for a drogue at a given pose in steady flight.

    Args:
        rng: draws the lateral offset.
        drogue: whose coupling the hose enters.
        left_from_drogue, world_from_left: poses; world axes x east (the flight direction), y north, z up.

    Returns:
        `left_from_tanker`, and (17, 3) nodes from the coupling to the pod in the left camera. [m]
    """
    left_from_world = world_from_left.inverse()
    offset_world = np.array([_TRAIL_AFT_M, rng.uniform(-_LATERAL_SPREAD_M, _LATERAL_SPREAD_M), _TRAIL_BELOW_M])
    pod = left_from_drogue.translation_m + left_from_world.rotate(offset_world)
    tail_z_m = drogue.hub_depth_m + drogue.coupling_length_m - HOSE_OVERLAP_M
    tail = left_from_drogue.apply([0.0, 0.0, tail_z_m])
    length_m = float(np.linalg.norm(pod - tail))
    start_tangent = left_from_drogue.rotation[:, 2] * length_m
    into_pod = left_from_world.rotate(np.array([1.0, 0.0, _SLOPE_AT_POD]))
    end_tangent = into_pod / np.linalg.norm(into_pod) * length_m
    s = np.linspace(0.0, 1.0, HOSE_NODES)[:, None]
    # Cubic Hermite curve: the drogue's own direction at one end, the pod's at the other.
    nodes = (
        (2 * s**3 - 3 * s**2 + 1) * tail
        + (s**3 - 2 * s**2 + s) * start_tangent
        + (3 * s**2 - 2 * s**3) * pod
        + (s**3 - s**2) * end_tangent
    )
    return RigidTransform(left_from_world.rotation @ WORLD_FROM_TANKER, pod), nodes
