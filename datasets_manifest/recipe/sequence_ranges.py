"""The `[sequence]` section of a recipe: how hose, air and receiver move, and when the cameras lose the drogue."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator

from datasets_manifest.recipe.drogue_ranges import AppearanceRanges, PoseRanges
from datasets_manifest.recipe.environment_ranges import EnvironmentRanges
from datasets_manifest.types.environment import MIN_AIRSPEED_M_S, Turbulence
from datasets_manifest.types.field_types import Range
from datasets_manifest.types.frame import DropoutKind
from drogue_models.frozen_model import FrozenModel
from geometry.distortion import border_px
from geometry.stereo import EYES, StereoRig


class HoseParameters(FrozenModel):
    """A hose with the drogue at its end, and the air stream around them.

    Attributes:
        name: of the preset that it comes from.
        length_m: from the pod's exit to the drogue's coupling. [m]
        diameter_m: outer. [m]
        mass_per_length_kg_m: of the hose, with the fuel in it. [kg/m]
        drogue_mass_kg: [kg]
        drogue_diameter_m: of the disc to which its drag coefficient refers. [m]
        drogue_drag_coefficient: of the drogue.
        crossflow_drag_coefficient, skin_drag_coefficient: of the hose, for flow across and along it.
        airspeed_m_s: of tanker and receiver. [m/s]
        air_density_kg_m3: [kg/m3]
        turbulence_altitude_m: above ground; sets the scale and shape of the turbulence. [m]
    """

    name: str = Field(default="own", min_length=1, max_length=40)
    length_m: float = Field(gt=0.5, le=100)
    diameter_m: float = Field(gt=0, le=0.5)
    mass_per_length_kg_m: float = Field(gt=0, le=100)
    drogue_mass_kg: float = Field(gt=0, le=1000)
    drogue_diameter_m: float = Field(gt=0, le=5)
    drogue_drag_coefficient: float = Field(gt=0, le=3)
    crossflow_drag_coefficient: float = Field(default=1.1, ge=0, le=3)
    skin_drag_coefficient: float = Field(default=0.0035, ge=0, le=1)
    airspeed_m_s: float = Field(ge=0, le=300)
    air_density_kg_m3: float = Field(ge=0.05, le=1.5)
    turbulence_altitude_m: float = Field(ge=3, le=20_000)


# Values of a probe-and-drogue system of the fifty-foot class; from memory of the literature, not from a datasheet.
_FULL_SIZE = HoseParameters(
    name="full-size",
    length_m=15.0,
    diameter_m=0.067,
    mass_per_length_kg_m=4.1,
    drogue_mass_kg=29.5,
    drogue_diameter_m=0.61,
    drogue_drag_coefficient=0.8,
    airspeed_m_s=120.0,
    air_density_kg_m3=0.59,  # standard atmosphere at 6.9 km
    turbulence_altitude_m=6900.0,
)
# A pair of small rotorcraft as in the seed paper; the drogue's size is the paper's, hose and drag are our assumption.
_SMALL_UAV = HoseParameters(
    name="small-uav",
    length_m=4.0,
    diameter_m=0.02,
    mass_per_length_kg_m=0.25,
    drogue_mass_kg=3.0,
    drogue_diameter_m=0.66,
    drogue_drag_coefficient=0.8,
    airspeed_m_s=20.0,
    air_density_kg_m3=1.2,
    turbulence_altitude_m=100.0,
)

HOSES: dict[str, HoseParameters] = {hose.name: hose for hose in (_FULL_SIZE, _SMALL_UAV)}


def _resolve_hose(value: Any) -> Any:
    """All parameters, from a preset's name or from a table that changes a preset."""
    table = {"preset": value} if isinstance(value, str) else value
    if not isinstance(table, dict) or "preset" not in table:
        return value
    changes = {key: change for key, change in table.items() if key != "preset"}
    if not isinstance(table["preset"], str) or table["preset"] not in HOSES:
        raise ValueError(f"preset: no hose named {table['preset']!r}; there are {', '.join(HOSES)}")
    return {**HOSES[table["preset"]].model_dump(), **changes}


Hose = Annotated[HoseParameters, BeforeValidator(_resolve_hose)]
"""In TOML the name of a preset, a table with `preset` and what differs from it, or all parameters."""


DropoutKindOrNone = DropoutKind | Literal["none"]

# The sun stands near the receiver's line of sight to the drogue; slow attitude changes and the swinging drogue lower
# that line by up to this. [deg]
_LINE_OF_SIGHT_DROP_DEG = 4.0
# Largest share of its offset by which the sun stands below the drogue: sin 45 degrees, rounded up.
_LARGEST_SUN_DROP_FRACTION = 0.71


class DropoutRanges(FrozenModel):
    """Distribution of the dropouts: one period in each sequence in which the drogue is hidden or hard to see.

    Attributes:
        kinds: used in turn, sequence by sequence. `occlusion` moves a bar before both cameras that hides all of the
            drogue; `out-of-view` turns the receiver until neither eye sees any of it; `glare` turns the formation until
            the sun stands beside the drogue; `none` leaves a sequence unchanged.
        begins_s: from the sequence's start until the drogue is lost. [s]
        lasts_s: duration. [s]
        onset_s: duration of the bar's, or the turn's, approach, and again of its return. [s]
        obstacle_distance_m: of the bar's axis from the cameras. [m]
        turn_deg: of the receiver, to the left or to the right, for `out-of-view`. [deg]
        sun_offset_deg: angle from the drogue's edge to the sun, seen from the receiver, in the middle of the dropout,
            for `glare`. [deg]
        sweep_deg: heading offset of the formation before and after the dropout, to either side, for `glare`. [deg]
    """

    kinds: tuple[DropoutKindOrNone, ...] = Field(min_length=1, max_length=40)
    begins_s: Range = Range(low=2, high=2)
    lasts_s: Range = Range(low=2, high=2)
    onset_s: Range = Range(low=1, high=1)
    obstacle_distance_m: Range = Range(low=0.8, high=1.2)
    turn_deg: Range = Range(low=28, high=32)
    sun_offset_deg: Range = Range(low=0.3, high=0.8)
    sweep_deg: Range = Range(low=12, high=16)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name, low, high in (
            ("begins_s", 0, 36_000),
            ("lasts_s", 0, 36_000),
            ("onset_s", 0.02, 60),
            ("obstacle_distance_m", 0.3, 10),
            ("turn_deg", 5, 55),
            ("sun_offset_deg", 0, 30),
            ("sweep_deg", 1, 60),
        ):
            getattr(self, name).within(low, high, name)
        if self.begins_s.low < self.onset_s.high:
            raise ValueError(
                f"begins_s: must be at least onset_s, {self.onset_s.high:g} s, so that a sequence begins with the "
                f"drogue in sight, got {self.begins_s.low:g}"
            )
        return self

    @property
    def end_s(self) -> float:
        """Latest time at which the drogue is in sight again. [s]"""
        return self.begins_s.high + self.lasts_s.high + self.onset_s.high

    def check_turn(self, rig: StereoRig, rim_radius_m: float, distance_m: float, beside_m: float) -> None:
        """Check that the turn takes the drogue out of both views.

        Args:
            rig: the cameras.
            rim_radius_m: of the drogue. [m]
            distance_m: of the drogue. [m]
            beside_m: lateral distance of the drogue from the axis midway between the eyes. [m]

        Raises:
            ValueError: part of it stays in view.
        """
        if "out-of-view" not in self.kinds:
            return
        # A barrel lens sees more than the ideal image, most in its corners.
        widest = max(float(abs(rig.rays(border_px(rig.camera), eye)[:, 0]).max()) for eye in EYES)
        half_field_deg = math.degrees(math.atan(widest))
        beside_deg = math.degrees(math.atan((beside_m + rim_radius_m + rig.baseline_m) / distance_m))
        needed_deg = half_field_deg + beside_deg
        if self.turn_deg.low < needed_deg:
            raise ValueError(
                f"sequence.losses.turn_deg: {self.turn_deg.low:g} degrees leave part of the drogue in view at "
                f"{distance_m:g} m; turn by at least {needed_deg:.1f}, and more where it swings"
            )

    def check_sun(self, pose: PoseRanges, environment: EnvironmentRanges) -> None:
        """Check that the sun can stand beside the drogue.

        Raises:
            ValueError: the sun would stand below the horizon, or an environment map fixes it.
        """
        if "glare" not in self.kinds:
            return
        if environment.map is not None:
            raise ValueError("sequence.losses.kinds: glare moves the sun, and that of environment.map cannot be moved")
        needed_deg = _LINE_OF_SIGHT_DROP_DEG + _LARGEST_SUN_DROP_FRACTION * self.sun_offset_deg.high
        if pose.camera_pitch_deg.low < needed_deg:
            raise ValueError(
                "pose.camera_pitch_deg: glare needs the receiver to look up at the drogue by at least "
                f"{needed_deg:.3g} degrees, or the sun beside it would be below the horizon, got "
                f"{pose.camera_pitch_deg.low:g}"
            )


Manoeuvre = Literal["docking", "station", "missed-approach"]

# Acceleration of a receiver to its closure speed, and its deceleration. [m/s2]
CLOSURE_ACCELERATION_M_S2 = 0.5
_NOTHING = Range(low=0, high=0)
# In a sequence the flight dynamics replace these keys of `[pose]`.
_POSE_OF_SINGLES = ("pitch_deg", "yaw_deg", "on_axis", "speed_m_s", "rate_deg_s")


class Follower(FrozenModel):
    """Second-order guidance law that keeps the drogue near the axis of the rig.

    Attributes:
        bandwidth_hz: natural frequency; 0 flies to the drogue's equilibrium position in still air. [Hz]
        delay_s: age of its measurement of the drogue, which it extrapolates at constant velocity. [s]
        acceleration_limit_m_s2: of the receiver relative to the tanker. [m/s2]
    """

    bandwidth_hz: float = Field(default=0.8, ge=0, le=5)
    delay_s: float = Field(default=0.1, ge=0, le=2)
    acceleration_limit_m_s2: float = Field(default=6.0, gt=0, le=100)


class Receiver(FrozenModel):
    """Manoeuvres and vibration of the receiver; distances are those of the rim's centre along the optical axis.

    Attributes:
        manoeuvres: used in turn, sequence by sequence. `docking` closes from `start_m` to `end_m` and stays there;
            `station` stays at `start_m`; `missed-approach` closes to `abort_m` and returns to `start_m`.
        start_m, end_m, abort_m: [m]
        closure_m_s: [m/s]
        hold_s: time at `start_m` before it closes. [s]
        offset_right_m, offset_down_m: of the drogue from the rig's axis; drawn by sequence. Docking reduces them in
            proportion to the remaining distance. [m]
        follower: its guidance.
        body_radius_m: of its nose, far behind the tip, for the bow wave; 0 for none. [m]
        nose_body_m: the tip of its nose from the left eye: forward, right, down. [m]
        attitude_sd_deg: standard deviation of each angle at low frequencies (0.05 to 0.6 Hz). [deg]
        vibration_deg: standard deviation of each angle at high frequencies (8 to 40 Hz). [deg]
        vibration_m: standard deviation of each axis at high frequencies. [m]
    """

    manoeuvres: tuple[Manoeuvre, ...] = Field(default=("docking",), min_length=1, max_length=40)
    start_m: float = Field(default=10.0, gt=0, le=200)
    end_m: float = Field(default=1.7, gt=0, le=200)
    abort_m: float = Field(default=3.0, gt=0, le=200)
    closure_m_s: float = Field(default=0.6, gt=0, le=20)
    hold_s: float = Field(default=1.0, ge=0, le=600)
    offset_right_m: Range = _NOTHING
    offset_down_m: Range = _NOTHING
    follower: Follower = Follower()
    body_radius_m: float = Field(default=0.5, ge=0, le=5)
    nose_body_m: tuple[float, float, float] = (0.0, 0.06, 0.6)
    attitude_sd_deg: float = Field(default=0.3, ge=0, le=10)
    vibration_deg: float = Field(default=0.01, ge=0, le=2)
    vibration_m: float = Field(default=0.0002, ge=0, le=0.05)

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        for name, kind in (("end_m", "docking"), ("abort_m", "missed-approach")):
            near = getattr(self, name)
            if kind in self.manoeuvres and near >= self.start_m:
                raise ValueError(f"{name}: must be below start_m, {self.start_m:g} m, got {near:g}")
        return self

    def nearest_m(self, manoeuvre: Manoeuvre) -> float:
        """Smallest distance of a manoeuvre. [m]"""
        return {"docking": self.end_m, "station": self.start_m, "missed-approach": self.abort_m}[manoeuvre]

    def duration_s(self, manoeuvre: Manoeuvre) -> float:
        """Duration of a manoeuvre; 0 for one without an end. [s]"""
        if manoeuvre == "station":
            return 0.0
        leg_s = run_time_s(self.start_m - self.nearest_m(manoeuvre), self.closure_m_s)
        return self.hold_s + leg_s * (2 if manoeuvre == "missed-approach" else 1)


def run_time_s(length_m: float, speed_m_s: float) -> float:
    """Duration of a run over a length, from rest to rest. [s]"""
    peak_m_s = min(speed_m_s, math.sqrt(length_m * CLOSURE_ACCELERATION_M_S2))
    return length_m / peak_m_s + peak_m_s / CLOSURE_ACCELERATION_M_S2


MOST_SEQUENCE_S = 7200.0
"""The longest sequence: the motion up to its last frame is computed at once, at some 200 s of it a second. [s]"""


class SequenceRanges(FrozenModel):
    """Distribution of the sequences of a recipe; each has a scene, a hose motion and turbulence of its own.

    Attributes:
        frames_per_sequence: number of pairs N in each; frame k is pair k modulo N of sequence k // N.
        frame_rate_hz: rate of the exposures' middles, which are evenly spaced. [Hz]
        hose: preset, table or all parameters.
        turbulence: severities, used in turn, sequence by sequence; TOML also takes a single name.
        tanker_motion_m: standard deviation of the pod about its mean position, along each axis (0.05 to 0.2 Hz). [m]
        release_m: position at which the drogue's coupling is released from rest at the beginning: aft, right, up of the
            pod; without it the hose already moves with the air. [m]
        receiver: its manoeuvres.
        losses: dropouts, or none.
    """

    frames_per_sequence: int = Field(ge=1, le=100_000)
    frame_rate_hz: float = Field(default=25.0, gt=0, le=1000)
    hose: Hose = Field(default="full-size", validate_default=True)
    turbulence: tuple[Turbulence, ...] = Field(default=("light",), min_length=1, max_length=40)
    tanker_motion_m: float = Field(default=0.05, ge=0, le=5)
    release_m: tuple[float, float, float] | None = None
    receiver: Receiver = Receiver()
    # Left out where there is none, so that the hashes of other recipes stay those of earlier versions.
    losses: DropoutRanges | None = Field(default=None, exclude_if=lambda losses: losses is None)

    @field_validator("turbulence", mode="before")
    @classmethod
    def _one_severity(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.release_m is not None:
            away_m = sum(part**2 for part in self.release_m) ** 0.5
            if away_m >= self.hose.length_m:
                raise ValueError(
                    f"hose.length_m: a hose of {self.hose.length_m:g} m is shorter than the {away_m:.3g} m from the "
                    "pod to release_m; lengthen it or release the drogue nearer to the pod"
                )
        if self.hose.airspeed_m_s < MIN_AIRSPEED_M_S and set(self.turbulence) != {"none"}:
            raise ValueError(
                f"turbulence: needs an airspeed of at least {MIN_AIRSPEED_M_S:g} m/s, got {self.hose.airspeed_m_s:g}; "
                "use 'none'"
            )
        span_s = (self.frames_per_sequence - 1) / self.frame_rate_hz
        if span_s > MOST_SEQUENCE_S:
            raise ValueError(
                f"frame_rate_hz: {self.frames_per_sequence} frames at {self.frame_rate_hz:g} Hz last {span_s:.4g} s, "
                f"at most {MOST_SEQUENCE_S:g} s can be flown; raise frame_rate_hz, or lower frames_per_sequence"
            )
        for manoeuvre in self.receiver.manoeuvres:
            needed_s = self.receiver.duration_s(manoeuvre)
            if span_s < needed_s:
                raise ValueError(
                    f"frames_per_sequence: {manoeuvre} takes {needed_s:.4g} s, which is "
                    f"{int(needed_s * self.frame_rate_hz) + 2} frames, got {self.frames_per_sequence}"
                )
        if self.losses is not None and span_s < self.losses.end_s:
            raise ValueError(
                f"frames_per_sequence: dropouts last until {self.losses.end_s:.4g} s, which is "
                f"{int(self.losses.end_s * self.frame_rate_hz) + 2} frames, got {self.frames_per_sequence}"
            )
        return self

    @property
    def nearest_m(self) -> float:
        """Smallest distance of all manoeuvres. [m]"""
        return min(self.receiver.nearest_m(manoeuvre) for manoeuvre in self.receiver.manoeuvres)

    def check_view(self, rig: StereoRig, rim_radius_m: float) -> None:
        """Check that both eyes see the whole drogue along the intended path, outside dropouts.

        Raises:
            ValueError: they do not, or the turn of a dropout leaves part of the drogue in view.
        """
        receiver = self.receiver
        for manoeuvre in receiver.manoeuvres:
            near_m = receiver.nearest_m(manoeuvre)
            ends = [(receiver.start_m, 1.0), (near_m, 0.0 if manoeuvre == "docking" else 1.0)]
            for depth_m, share in ends:
                field = rig.common_field_m(depth_m, rim_radius_m)
                across, down = receiver.offset_right_m, receiver.offset_down_m
                if self.losses is not None:
                    self.losses.check_turn(rig, rim_radius_m, depth_m, share * max(-across.low, across.high))
                right = [rig.baseline_m / 2 + share * end for end in (across.low, across.high)]
                below = [share * end for end in (down.low, down.high)]
                seen = field is not None and (
                    field[0] <= right[0] and right[1] <= field[1] and field[2] <= below[0] and below[1] <= field[3]
                )
                if not seen:
                    raise ValueError(
                        f"sequence.receiver: {manoeuvre} leaves the visible volume at {depth_m:g} m, where both eyes "
                        f"must see the whole drogue; keep beyond {rig.nearest_full_view_m(rim_radius_m):.2f} m and "
                        "make offset_right_m and offset_down_m smaller"
                    )


def check_single_frame_keys(pose: PoseRanges, target: AppearanceRanges) -> None:
    """Check that a recipe with sequences sets no keys that apply to single frames only.

    Raises:
        ValueError: it sets one; names it.
    """
    plain = PoseRanges()
    for name in _POSE_OF_SINGLES:
        if getattr(pose, name) != getattr(plain, name):
            raise ValueError(f"pose.{name}: in a recipe with [sequence] the motion decides; leave it out")
    if target.distractor_frame_fraction > 0:
        raise ValueError("target.distractor_frame_fraction: is drawn by frame, and [sequence] needs it to be 0")


def fill_distance(table: dict[str, Any]) -> None:
    """Add the `[distance]` that follows from a recipe table's `[sequence]`, if it has one, in place.

    Raises:
        ValueError: the table has a `[distance]` of its own.
    """
    given = table.get("sequence")
    if given is None:
        return
    if "distance" in table:
        raise ValueError("distance: in a recipe with [sequence] the receiver decides; leave it out")
    try:
        sequence = SequenceRanges.model_validate(given)
        ends = (sequence.nearest_m, sequence.receiver.start_m)
    except ValidationError:
        ends = (1.0, 1.0)  # the schema will name what is wrong
    table["distance"] = {"law": "uniform", "low_m": ends[0], "high_m": ends[1]}
