"""Poses and motion at the time of one stereo pair."""

from __future__ import annotations

from dataclasses import dataclass

from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import DropoutKind
from geometry.se3 import Array, RigidTransform


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
