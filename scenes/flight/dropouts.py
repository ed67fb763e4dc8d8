"""Dropouts of a sequence, in which the cameras lose the drogue: behind a bar, by a turn aside, or beside the sun."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from datasets_manifest.recipe.sequence_ranges import DropoutRanges
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import DropoutKind
from drogue_models.frozen_model import ReflectanceRgb
from drogue_models.obstacles import ObstacleShape
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from scenes.environment_sampling import sample_uniform
from scenes.framing import rotation_with_z

# The bar is wider by this share, for the canopy behind the rim and for motion between the samples.
_SPARE_FRACTION = 0.15
_SAMPLES = 121
_GREY_PAINT: ReflectanceRgb = (0.20, 0.21, 0.22)


@dataclass(frozen=True)
class DropoutEvent:
    """One dropout; times count from the start of the sequence.

    Attributes:
        kind: cause of the dropout.
        begin_s, end_s: the drogue is lost between these times. [s]
        onset_s: duration of the onset, and of the end. [s]
        side: 1 or -1: side from which the bar comes, to which receiver and formation turn, and on which the sun stands.
        tilt_rad: direction of the bar in the image; the sun stands across it from the drogue. [rad]
        obstacle_distance_m: distance of the bar's axis from the cameras. [m]
        turn_rad: angle that the receiver turns. [rad]
        sun_offset_rad: angle between sun and edge of the drogue. [rad]
        sweep_rad: angle that the formation's heading changes. [rad]
    """

    kind: DropoutKind
    begin_s: float
    end_s: float
    onset_s: float
    side: int
    tilt_rad: float
    obstacle_distance_m: float
    turn_rad: float
    sun_offset_rad: float
    sweep_rad: float

    @property
    def middle_s(self) -> float:
        """Middle of the dropout. [s]"""
        return (self.begin_s + self.end_s) / 2

    def phase(self, time_s: float) -> float:
        """1 before the onset, 0 during the dropout, -1 after its end; smooth in between."""
        before_s, after_s = self.begin_s - time_s, time_s - self.end_s
        late_s = max(before_s, after_s, 0.0)
        share = 0.5 - 0.5 * float(np.cos(np.pi * min(late_s / self.onset_s, 1.0)))
        return share if before_s > 0 else -share

    def is_active(self, time_s: float) -> bool:
        """Whether the dropout or its onset or end is under way."""
        return abs(self.phase(time_s)) < 1

    def receiver_rotation(self, time_s: float) -> Array:
        """(3, 3) rotation of the receiver's eyes by a turn aside; otherwise the identity."""
        angle = 0.0
        if self.kind == "out-of-view":
            angle = self.side * self.turn_rad * (1.0 - abs(self.phase(time_s)))
        cosine, sine = np.cos(angle), np.sin(angle)
        return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])

    def heading_rad(self, time_s: float) -> float:
        """Heading of the formation, from east towards north; 0 except for glare. [rad]"""
        return self.side * self.sweep_rad * self.phase(time_s) if self.kind == "glare" else 0.0

    def formation_rotation(self, time_s: float) -> Array:
        """(3, 3) rotation of the formation about the vertical by its heading."""
        heading = self.heading_rad(time_s)
        cosine, sine = np.cos(heading), np.sin(heading)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def sample_dropout(rng: np.random.Generator, ranges: DropoutRanges | None, sequence_id: int) -> DropoutEvent | None:
    """The dropout of a sequence, or None without one; the draws do not depend on its kind."""
    if ranges is None:
        return None
    kind = ranges.kinds[sequence_id % len(ranges.kinds)]
    begin_s, lasts_s, onset_s = (
        sample_uniform(rng, ranges.begins_s),
        sample_uniform(rng, ranges.lasts_s),
        sample_uniform(rng, ranges.onset_s),
    )
    side, tilt_rad = int(rng.choice([-1, 1])), float(rng.uniform(np.pi / 4, 3 * np.pi / 4))
    distance_m = sample_uniform(rng, ranges.obstacle_distance_m)
    turn, offset, sweep = np.radians(
        [sample_uniform(rng, r) for r in (ranges.turn_deg, ranges.sun_offset_deg, ranges.sweep_deg)]
    )
    if kind == "none":
        return None
    end_s = begin_s + lasts_s
    return DropoutEvent(
        kind=kind,
        begin_s=begin_s,
        end_s=end_s,
        onset_s=onset_s,
        side=side,
        tilt_rad=tilt_rad,
        obstacle_distance_m=distance_m,
        turn_rad=float(turn),
        sun_offset_rad=float(offset),
        sweep_rad=float(sweep),
    )


@dataclass(frozen=True, eq=False)
class OccludingBar:
    """A bar that hides the drogue from both eyes throughout a dropout.

    Attributes:
        event: the dropout.
        baseline_m: of the rig. [m]
        across: (2,) direction across the bar, right and down in the image.
        middle_m: position of its axis along that direction during the dropout, from midway between the eyes. [m]
        radius_m: of the bar. [m]
    """

    event: DropoutEvent
    baseline_m: float
    across: Array
    middle_m: float
    radius_m: float

    def at(self, time_s: float, camera: PinholeCamera) -> Obstacle | None:
        """The bar at a time of the sequence, or None while neither eye sees it."""
        phase, depth_m = self.event.phase(time_s), self.event.obstacle_distance_m
        if abs(phase) == 1:
            return None
        corner = float(np.hypot(camera.width_px / 2 / camera.fx_px, camera.height_px / 2 / camera.fy_px))
        # At this distance the line of sight through the farthest corner just touches the bar, or misses it.
        far_m = depth_m * corner + self.radius_m * float(np.hypot(1.0, corner)) + self.baseline_m + abs(self.middle_m)
        x_m, y_m = self.across * (self.middle_m + self.event.side * phase * far_m)
        along = np.array([self.across[1], -self.across[0], 0.0])
        return Obstacle(
            kind="obstacle",
            shape=ObstacleShape(form="bar", radius_m=self.radius_m, length_m=min(4 * far_m, 50.0)),
            left_from_object=RigidTransform(
                rotation_with_z(along), np.array([self.baseline_m / 2 + x_m, y_m, depth_m])
            ),
            reflectance_rgb=_GREY_PAINT,
        )


def occluding_bar(
    event: DropoutEvent, points_m: Array, baseline_m: float, left_from_drogue: Callable[[float], RigidTransform]
) -> OccludingBar:
    """A bar thick enough to hide the drogue wherever it moves during the dropout.

    It hides at least the strip of twice its radius through its axis: the lines of sight that touch it pass outside.

    Args:
        event: an occlusion.
        points_m: (M, 3) outline of the drogue. [m]
        baseline_m: of the rig. [m]
        left_from_drogue: pose at a time of the sequence.

    Raises:
        ValueError: the bar would reach to the lens, or would not be in front of all of the drogue.
    """
    depth_m = event.obstacle_distance_m
    across = np.array([-np.sin(event.tilt_rad), np.cos(event.tilt_rad)])
    places = []
    for time_s in np.linspace(event.begin_s, event.end_s, _SAMPLES):
        points = left_from_drogue(float(time_s)).apply(points_m)
        for eye in (np.zeros(2), np.array([baseline_m, 0.0])):
            seen = eye + (points[:, :2] - eye) * depth_m / points[:, 2:]
            places.append((seen - [baseline_m / 2, 0.0]) @ across)
    low, high = float(np.min(places)), float(np.max(places))
    radius_m = (high - low) / 2 * (1 + _SPARE_FRACTION)
    if radius_m > depth_m / 2:
        raise ValueError(
            f"sequence.losses.obstacle_distance_m: a bar that hides the drogue throughout has a radius of "
            f"{radius_m:.2f} m, too much {depth_m:.2f} m in front of the cameras; take calmer air or a greater distance"
        )
    # During onset and end it passes in front of the drogue too.
    active_s = np.linspace(event.begin_s - event.onset_s, event.end_s + event.onset_s, _SAMPLES)
    nearest_m = min(float(left_from_drogue(float(time_s)).apply(points_m)[:, 2].min()) for time_s in active_s)
    if depth_m + radius_m >= nearest_m:
        raise ValueError(
            f"sequence.losses.obstacle_distance_m: a bar of {radius_m:.2f} m radius {depth_m:.2f} m before the cameras "
            f"is not in front of all of the drogue, which comes to {nearest_m:.2f} m; take a smaller distance"
        )
    return OccludingBar(event=event, baseline_m=baseline_m, across=across, middle_m=(low + high) / 2, radius_m=radius_m)


def sun_beside_drogue_deg(
    event: DropoutEvent, world_from_left: RigidTransform, middle_m: Array, radius_m: float
) -> tuple[float, float]:
    """Position of a sun that stands beside the drogue.

    Args:
        event: a glare.
        world_from_left: attitude of the camera in the middle of the dropout.
        middle_m: (3,) middle of the drogue then, in the left camera. [m]
        radius_m: of the drogue. [m]

    Returns:
        Elevation and azimuth. [deg]

    Raises:
        ValueError: the position is below the horizon.
    """
    sight = middle_m / np.linalg.norm(middle_m)
    right = np.cross([0.0, 1.0, 0.0], sight)
    right /= np.linalg.norm(right)
    upwards = np.cross(sight, right) * -1.0
    # Rather to the left or right than above, where pod and wing would hide the sun.
    beside = event.side * np.sin(event.tilt_rad) * right + np.cos(event.tilt_rad) * upwards
    offset = event.sun_offset_rad + float(np.arcsin(radius_m / np.linalg.norm(middle_m)))
    to_sun = world_from_left.rotate(np.cos(offset) * sight + np.sin(offset) * beside)
    elevation_deg = float(np.degrees(np.arcsin(to_sun[2])))
    if elevation_deg < 0:
        raise ValueError(
            f"sequence.losses.sun_offset_deg: the sun beside the drogue would stand {-elevation_deg:.1f} degrees below "
            "the horizon; raise pose.camera_pitch_deg, or lower sun_offset_deg or sequence.receiver.offset_down_m"
        )
    return elevation_deg, float(np.degrees(np.arctan2(to_sun[1], to_sun[0])))


def formation_displacement_m(event: DropoutEvent, speed_m_s: float, time_s: float) -> Array:
    """(2,) east and north of a turning formation from its position at the start of the sequence. [m]"""
    begin_s, end_s, onset_s = event.begin_s, event.end_s, event.onset_s
    changes_s = np.clip([0.0, begin_s - onset_s, begin_s, end_s, end_s + onset_s, time_s], 0.0, time_s)
    displacement = np.zeros(2)
    # The heading changes in the onset and in the end alone.
    for low_s, high_s, samples in zip(changes_s, changes_s[1:], (1, _SAMPLES, 1, _SAMPLES, 1), strict=False):
        middles_s = low_s + (np.arange(samples) + 0.5) / samples * (high_s - low_s)
        headings = np.array([event.heading_rad(float(middle_s)) for middle_s in middles_s])
        displacement += speed_m_s * (high_s - low_s) * np.array([np.cos(headings).mean(), np.sin(headings).mean()])
    return displacement
