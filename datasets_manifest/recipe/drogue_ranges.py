"""Where the drogue is, how it moves and what it looks like: the `[distance]`, `[pose]` and `[target]` sections."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel
from drogue_models.obstacles import DistractorBody
from drogue_models.parameters import DrogueParameters


class DistanceLaw(FrozenModel):
    """Distribution of the distance of the rim centre along the optical axis.

    Attributes:
        law: `uniform`, `log-uniform` or `uniform-image-size` (uniform in 1/distance) between `low_m` and `high_m`; or
            `stations`, which takes the values of `stations_m` in turn, frame by frame.
        low_m, high_m: the law's ends; for all but `stations`. [m]
        stations_m: distances; for `stations` alone. [m]
        edges_m: ascending distances from `low_m` to `high_m`, the ends of bins within each of which the law holds;
            without them it holds from end to end. [m]
        weights: share of the frames in each bin, relative to the others; one fewer than `edges_m`.
    """

    law: Literal["uniform", "log-uniform", "uniform-image-size", "stations"]
    low_m: float | None = Field(default=None, gt=0, le=1000)
    high_m: float | None = Field(default=None, gt=0, le=1000)
    stations_m: tuple[Annotated[float, Field(gt=0, le=1000)], ...] | None = Field(default=None, min_length=1)
    # Left out at their default, so that the hashes of other recipes stay those of earlier versions.
    edges_m: tuple[Annotated[float, Field(gt=0, le=1000)], ...] | None = Field(
        default=None, min_length=2, max_length=1000, exclude_if=lambda edges: edges is None
    )
    weights: tuple[Annotated[float, Field(ge=0, le=1e6)], ...] | None = Field(
        default=None, max_length=999, exclude_if=lambda weights: weights is None
    )

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

    @model_validator(mode="after")
    def _bins(self) -> Self:
        if (self.edges_m is None) != (self.weights is None):
            raise ValueError("edges_m, weights: need each other")
        if self.edges_m is None or self.weights is None:
            return self
        if (self.edges_m[0], self.edges_m[-1]) != (self.low_m, self.high_m):
            raise ValueError("edges_m: must begin with low_m and end with high_m")
        if any(low >= high for low, high in pairwise(self.edges_m)):
            raise ValueError("edges_m: must ascend")
        if len(self.weights) != len(self.edges_m) - 1:
            raise ValueError(f"weights: need one for each of {len(self.edges_m) - 1} bins, got {len(self.weights)}")
        if sum(self.weights) <= 0:
            raise ValueError("weights: must not all be zero")
        return self

    @property
    def nearest_m(self) -> float:
        """Smallest distance that can be drawn. [m]"""
        return min(self.stations_m) if self.stations_m is not None else float(self.low_m or 0.0)


class PoseRanges(FrozenModel):
    """Distribution of the attitudes of drogue and receiver, and of the motion that blurs the images.

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


CONSTANT_ONE = Range(low=1, high=1)

DistractorForm = Literal["ball", "disc", "ring"] | DistractorBody
_PLAIN_DISTRACTORS: tuple[DistractorForm, ...] = ("ball", "disc", "ring")


class DrogueVariant(FrozenModel):
    """One of several drogues of a dataset.

    Attributes:
        drogue: in TOML the name of a preset or a TOML file.
        weight: its share of the scenes, relative to the other variants' weights.
    """

    drogue: DrogueParameters
    weight: float = Field(default=1.0, gt=0, le=1e6)


class WearRanges(FrozenModel):
    """Distribution of each scene's `SurfaceWear`, whose attributes these are; uniform, independent of each other."""

    soot: Range = Range(low=0.0, high=0.8)
    oil: Range = Range(low=0.0, high=0.7)
    edge_wear: Range = Range(low=0.05, high=0.8)
    fading: Range = Range(low=0.1, high=0.9)
    stitching: Range = Range(low=0.2, high=1.0)
    tape: Range = Range(low=0.0, high=0.3)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name in type(self).model_fields:
            getattr(self, name).within(0, 1, f"wear.{name}")
        return self


class AppearanceRanges(FrozenModel):
    """Distribution of each scene's drogue, its condition and the obstacles; by default a new drogue without obstacles.

    Attributes:
        variants: drogues to choose from by scene; empty for the recipe's own.
        missing_marker_fraction: probability that a marker has come off; at least three always stay.
        marker_reflectance_fraction: of each marker and the hub, see `SurfaceCondition`.
        dirty_marker_fraction: probability that a marker, or the hub, is dirty.
        dirt_fraction: share of a dirty surface under dirt.
        failed_lamp_fraction: probability that a self-lit marker is out.
        lamp_fraction: luminance of the other lamps, as a share of the drogue's.
        body_reflectance_fraction: see `DrogueCondition`.
        wear: of the drogue's paint, cloth and metal, drawn with the rest of its condition; without it paint is even.
        probe: whether the receiver's probe is drawn, with its tip at the rig's `probe_tip_body_m`.
        probe_radius_m: of its tube. [m]
        obstacle_frame_fraction: share of frames in which a bar close to the cameras may hide part of the drogue.
        distractor_frame_fraction: share of frames with other round objects; in frames without a drogue they are the
            hard negatives.
        distractor_forms: forms to choose from with equal probability; a form may be listed several times. `ball`,
            `disc` and `ring` are plain and as large in the image as a drogue; the others are painted, of their true
            sizes, and placed on the tanker or in the sky where they belong.
    """

    variants: tuple[DrogueVariant, ...] = ()
    missing_marker_fraction: Fraction = 0.0
    marker_reflectance_fraction: Range = CONSTANT_ONE
    dirty_marker_fraction: Fraction = 0.0
    dirt_fraction: Range = Range(low=0.05, high=0.4)
    failed_lamp_fraction: Fraction = 0.0
    lamp_fraction: Range = CONSTANT_ONE
    body_reflectance_fraction: Range = CONSTANT_ONE
    wear: WearRanges | None = Field(default=None, exclude_if=lambda wear: wear is None)
    probe: bool = False
    probe_radius_m: float = Field(default=0.04, gt=0, le=0.5)
    obstacle_frame_fraction: Fraction = 0.0
    distractor_frame_fraction: Fraction = 0.0
    distractor_forms: tuple[DistractorForm, ...] = Field(
        default=_PLAIN_DISTRACTORS, min_length=1, exclude_if=lambda forms: forms == _PLAIN_DISTRACTORS
    )

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.marker_reflectance_fraction.within(0, 1, "marker_reflectance_fraction")
        self.dirt_fraction.within(0, 1, "dirt_fraction")
        self.lamp_fraction.within(0, 1, "lamp_fraction")
        self.body_reflectance_fraction.within(0.1, 3, "body_reflectance_fraction")
        return self
