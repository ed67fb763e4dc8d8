"""How the sequences of a recipe lose the drogue for a while: the `[sequence.losses]` section."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.recipe.environment_ranges import EnvironmentRanges
from datasets_manifest.recipe.pose_ranges import Pose
from datasets_manifest.types.dropout import Loss
from datasets_manifest.types.ranges import Range
from drogue_models.frozen_model import FrozenModel
from geometry.stereo import StereoRig

LossOrNone = Loss | Literal["none"]

# The sun stands where the receiver looks, which its slow changes of attitude and the swing of the drogue lower. [deg]
_LOWEST_LOOK_DEG = 4.0
# Share of its offset by which the sun may stand below the drogue: sin 45 degrees, rounded up.
_MOST_DOWNWARDS = 0.71


class LossRanges(FrozenModel):
    """A stretch in each sequence over which the cameras do not see the drogue, or hardly; draws are by sequence.

    Attributes:
        kinds: sequence by sequence in turn. `occlusion` puts a bar before both cameras that hides all of the drogue;
            `out-of-view` turns the receiver aside until neither eye has any of it; `glare` has the formation turn until
            the sun stands beside the drogue; `none` leaves a sequence as it is.
        begins_s: from the sequence's start until the drogue is lost. [s]
        lasts_s: how long it is. [s]
        onset_s: how long the bar takes to come before the drogue, or the turn, and as long again to go. [s]
        obstacle_distance_m: of the bar's axis from the cameras. [m]
        turn_deg: of the receiver, to the left or to the right, for `out-of-view`. [deg]
        sun_offset_deg: of the sun from the drogue's edge as the receiver sees it, in the middle of the stretch, for
            `glare`. [deg]
        sweep_deg: heading of the formation before and after it, to either side, for `glare`. [deg]
    """

    kinds: tuple[LossOrNone, ...] = Field(min_length=1, max_length=40)
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
        """When the drogue is in sight again at the latest. [s]"""
        return self.begins_s.high + self.lasts_s.high + self.onset_s.high

    def check_turn(self, rig: StereoRig, rim_radius_m: float, distance_m: float, beside_m: float) -> None:
        """Check that a turned receiver has lost the drogue.

        Args:
            rig: the cameras.
            rim_radius_m: of the drogue. [m]
            distance_m: of the drogue. [m]
            beside_m: of the drogue from the axis midway between the eyes, to the left or to the right. [m]

        Raises:
            ValueError: it still has part of it in view.
        """
        if "out-of-view" not in self.kinds:
            return
        half_field_deg = math.degrees(math.atan((rig.camera.width_px / 2) / rig.camera.fx_px))
        beside_deg = math.degrees(math.atan((beside_m + rim_radius_m + rig.baseline_m) / distance_m))
        needed_deg = half_field_deg + beside_deg
        if self.turn_deg.low < needed_deg:
            raise ValueError(
                f"sequence.losses.turn_deg: {self.turn_deg.low:g} degrees leave part of the drogue in view at "
                f"{distance_m:g} m; turn by at least {needed_deg:.1f}, and more where it swings"
            )

    def check_sun(self, pose: Pose, environment: EnvironmentRanges) -> None:
        """Check that the sun can stand beside the drogue.

        Raises:
            ValueError: the receiver looks at the ground, or a map has a sun of its own.
        """
        if "glare" not in self.kinds:
            return
        if environment.map is not None:
            raise ValueError("sequence.losses.kinds: glare moves the sun, and that of environment.map cannot be moved")
        needed_deg = _LOWEST_LOOK_DEG + _MOST_DOWNWARDS * self.sun_offset_deg.high
        if pose.camera_pitch_deg.low < needed_deg:
            raise ValueError(
                "pose.camera_pitch_deg: glare needs the receiver to look up at the drogue by at least "
                f"{needed_deg:.3g} degrees, or the sun beside it would be below the horizon, got "
                f"{pose.camera_pitch_deg.low:g}"
            )
