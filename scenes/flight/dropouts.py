"""Stretches of a sequence over which the cameras lose the drogue: behind a bar, by a turn aside, beside the sun."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from datasets_manifest.recipe.sequence_ranges import DropoutRanges
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.frame import DropoutKind
from drogue_models.obstacles import ObstacleShape
from drogue_models.parameters import ReflectanceRgb
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array, RigidTransform
from scenes.drogue_appearance import rotation_with_z
from scenes.environment import draw

# The bar is this much wider than what it hides, for the canopy behind the rim and for what moves between the samples.
_SPARE_FRACTION = 0.15
_SAMPLES = 121
_GREY_PAINT: ReflectanceRgb = (0.20, 0.21, 0.22)


@dataclass(frozen=True)
class LossEvent:
    """One such stretch; times count from the sequence's start.

    Attributes:
        kind: what happens.
        begin_s, end_s: between which the drogue is lost. [s]
        onset_s: how long it takes to come, and to go. [s]
        side: 1 or -1: from where the bar comes, to where receiver and formation turn, and where the sun stands.
        tilt_rad: direction of the bar in the image, across which the sun stands from the drogue. [rad]
        obstacle_distance_m: of the bar's axis from the cameras. [m]
        turn_rad: of the receiver. [rad]
        sun_offset_rad: of the sun from the drogue's edge. [rad]
        sweep_rad: of the formation's heading. [rad]
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
        """Middle of the stretch. [s]"""
        return (self.begin_s + self.end_s) / 2

    def away(self, time_s: float) -> float:
        """How far it still is from happening: 1 long before, 0 while it lasts, -1 long after; smooth in between."""
        before_s, after_s = self.begin_s - time_s, time_s - self.end_s
        late_s = max(before_s, after_s, 0.0)
        share = 0.5 - 0.5 * float(np.cos(np.pi * min(late_s / self.onset_s, 1.0)))
        return share if before_s > 0 else -share

    def acts(self, time_s: float) -> bool:
        """Whether it comes, lasts or goes at a time."""
        return abs(self.away(time_s)) < 1

    def turned(self, time_s: float) -> Array:
        """(3, 3) rotation of the receiver's eyes against where they look otherwise; the identity but for a turn."""
        angle = 0.0
        if self.kind == "out-of-view":
            angle = self.side * self.turn_rad * (1.0 - abs(self.away(time_s)))
        cosine, sine = np.cos(angle), np.sin(angle)
        return np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])

    def heading_rad(self, time_s: float) -> float:
        """Heading of the formation, from east towards north; 0 but for glare. [rad]"""
        return self.side * self.sweep_rad * self.away(time_s) if self.kind == "glare" else 0.0

    def headed(self, time_s: float) -> Array:
        """(3, 3) rotation of the formation about the vertical by its heading."""
        heading = self.heading_rad(time_s)
        cosine, sine = np.cos(heading), np.sin(heading)
        return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def sample_loss(rng: np.random.Generator, ranges: DropoutRanges | None, sequence_id: int) -> LossEvent | None:
    """What happens in a sequence, or None where nothing does; the draws do not depend on what it is."""
    if ranges is None:
        return None
    kind = ranges.kinds[sequence_id % len(ranges.kinds)]
    begin_s, lasts_s, onset_s = draw(rng, ranges.begins_s), draw(rng, ranges.lasts_s), draw(rng, ranges.onset_s)
    side, tilt_rad = int(rng.choice([-1, 1])), float(rng.uniform(np.pi / 4, 3 * np.pi / 4))
    distance_m = draw(rng, ranges.obstacle_distance_m)
    turn, offset, sweep = np.radians([draw(rng, r) for r in (ranges.turn_deg, ranges.sun_offset_deg, ranges.sweep_deg)])
    if kind == "none":
        return None
    end_s = begin_s + lasts_s
    return LossEvent(
        kind, begin_s, end_s, onset_s, side, tilt_rad, distance_m, float(turn), float(offset), float(sweep)
    )


@dataclass(frozen=True, eq=False)
class HidingBar:
    """A bar that hides the drogue from both eyes all through a stretch.

    Attributes:
        event: when it does.
        baseline_m: of the rig. [m]
        across: (2,) direction across the bar, right and down in the image.
        middle_m: where its axis stands then along that direction, from the axis midway between the eyes. [m]
        radius_m: of the bar. [m]
    """

    event: LossEvent
    baseline_m: float
    across: Array
    middle_m: float
    radius_m: float

    def at(self, time_s: float, camera: PinholeCamera) -> Obstacle | None:
        """The bar at a time of the sequence, or None while it is out of sight of both eyes."""
        away, depth_m = self.event.away(time_s), self.event.obstacle_distance_m
        if abs(away) == 1:
            return None
        corner = float(np.hypot(camera.width_px / 2 / camera.fx_px, camera.height_px / 2 / camera.fy_px))
        # There the line of sight through the farthest corner just touches the bar, or passes it.
        far_m = depth_m * corner + self.radius_m * float(np.hypot(1.0, corner)) + self.baseline_m + abs(self.middle_m)
        x_m, y_m = self.across * (self.middle_m + self.event.side * away * far_m)
        along = np.array([self.across[1], -self.across[0], 0.0])
        return Obstacle(
            kind="obstacle",
            shape=ObstacleShape(form="bar", radius_m=self.radius_m, length_m=min(4 * far_m, 50.0)),
            left_from_object=RigidTransform(
                rotation_with_z(along), np.array([self.baseline_m / 2 + x_m, y_m, depth_m])
            ),
            reflectance_rgb=_GREY_PAINT,
        )


def hiding_bar(
    event: LossEvent, points_m: Array, baseline_m: float, left_from_drogue: Callable[[float], RigidTransform]
) -> HidingBar:
    """A bar as thick as the drogue's way behind it asks for.

    It hides at least the strip of twice its radius through its axis: the lines of sight that touch it pass outside.

    Args:
        event: an occlusion.
        points_m: (M, 3) outline of the drogue. [m]
        baseline_m: of the rig. [m]
        left_from_drogue: pose at a time of the sequence.

    Raises:
        ValueError: the bar would reach to the lens, or not stand before all of the drogue.
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
            f"sequence.losses.obstacle_distance_m: a bar that hides the drogue all along has a radius of "
            f"{radius_m:.2f} m, too much {depth_m:.2f} m before the cameras; take calmer air or a greater distance"
        )
    # While it comes and goes it passes before the drogue too.
    acts_s = np.linspace(event.begin_s - event.onset_s, event.end_s + event.onset_s, _SAMPLES)
    nearest_m = min(float(left_from_drogue(float(time_s)).apply(points_m)[:, 2].min()) for time_s in acts_s)
    if depth_m + radius_m >= nearest_m:
        raise ValueError(
            f"sequence.losses.obstacle_distance_m: a bar of {radius_m:.2f} m radius {depth_m:.2f} m before the cameras "
            f"does not stand before all of the drogue, which comes to {nearest_m:.2f} m; take a smaller distance"
        )
    return HidingBar(event, baseline_m, across, (low + high) / 2, radius_m)


def sun_beside(
    event: LossEvent, world_from_left: RigidTransform, middle_m: Array, radius_m: float
) -> tuple[float, float]:
    """Where the sun stands that comes beside the drogue.

    Args:
        event: a glare.
        world_from_left: attitude of the camera in the middle of the stretch.
        middle_m: (3,) middle of the drogue then, in the left camera. [m]
        radius_m: of the drogue. [m]

    Returns:
        Elevation and azimuth. [deg]

    Raises:
        ValueError: that is below the horizon.
    """
    sight = middle_m / np.linalg.norm(middle_m)
    right = np.cross([0.0, 1.0, 0.0], sight)
    right /= np.linalg.norm(right)
    upwards = np.cross(sight, right) * -1.0
    # To the left or right rather than above, where pod and wing would hide it.
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


def flown_m(event: LossEvent, speed_m_s: float, time_s: float) -> Array:
    """(2,) east and north of the formation from its place at the sequence's start, for one that turns. [m]"""
    middles = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * time_s
    headings = np.array([event.heading_rad(float(middle)) for middle in middles])
    way: Array = speed_m_s * time_s * np.array([np.cos(headings).mean(), np.sin(headings).mean()])
    return way
