"""The `[distance]` and `[pose]` sections of a recipe."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.types.ranges import Range
from drogue_models.frozen_model import FrozenModel


class DistanceLaw(FrozenModel):
    """How the distance of the rim centre along the optical axis is drawn.

    Attributes:
        law: `uniform`, `log-uniform`, `uniform-image-size` (uniform in 1/distance) between `low_m` and `high_m`, or
            `stations`, which frame by frame go through `stations_m`.
    """

    law: Literal["uniform", "log-uniform", "uniform-image-size", "stations"]
    low_m: float | None = Field(default=None, gt=0, le=1000)
    high_m: float | None = Field(default=None, gt=0, le=1000)
    stations_m: tuple[Annotated[float, Field(gt=0, le=1000)], ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.law == "stations":
            if self.stations_m is None or self.low_m is not None or self.high_m is not None:
                raise ValueError("stations_m: the law 'stations' takes stations_m, and neither low_m nor high_m")
        elif self.low_m is None or self.high_m is None or self.stations_m is not None:
            raise ValueError(f"low_m, high_m: the law '{self.law}' takes both, and no stations_m")
        elif self.low_m > self.high_m:
            raise ValueError(f"low_m: {self.low_m:g} is above high_m, {self.high_m:g}")
        return self

    @property
    def nearest_m(self) -> float:
        """Nearest distance that can be drawn. [m]"""
        return min(self.stations_m) if self.stations_m is not None else float(self.low_m or 0.0)


class Pose(FrozenModel):
    """Attitude of drogue and receiver, and the motion that blurs.

    Attributes:
        pitch_deg, yaw_deg, roll_deg: of the drogue in the camera.
        on_axis: the drogue's centre on the rig's axis instead of anywhere in the common field of view.
        camera_pitch_deg, camera_bank_deg: of the receiver against the horizon.
        speed_m_s: largest component of the drogue's velocity. [m/s]
        rate_deg_s: largest component of the angular velocities of drogue and receiver. [deg/s]
    """

    pitch_deg: Range = Range(low=-10, high=10)
    yaw_deg: Range = Range(low=-10, high=10)
    roll_deg: Range = Range(low=-22.5, high=22.5)
    on_axis: bool = False
    camera_pitch_deg: Range = Range(low=-4, high=4)
    camera_bank_deg: Range = Range(low=-5, high=5)
    speed_m_s: float = Field(default=0.0, ge=0, le=100)
    rate_deg_s: float = Field(default=0.0, ge=0, le=360)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.pitch_deg.within(-60, 60, "pitch_deg")
        self.yaw_deg.within(-60, 60, "yaw_deg")
        self.roll_deg.within(-180, 180, "roll_deg")
        self.camera_pitch_deg.within(-45, 45, "camera_pitch_deg")
        self.camera_bank_deg.within(-90, 90, "camera_bank_deg")
        return self
