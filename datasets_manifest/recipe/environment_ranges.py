"""The `[environment]` section of a recipe: the ranges that each scene's sky, weather and ground are drawn from."""

from __future__ import annotations

from typing import Self

from pydantic import Field, field_validator, model_validator

from datasets_manifest.types.environment import LEAST_THICKNESS_M, CloudKind, EnvironmentMapFile, GroundKind, SkyModel
from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel


class Clouds(FrozenModel):
    """Distribution of one cloud layer.

    Attributes:
        kind: see `CloudLayer`.
        scene_fraction: share of scenes with this layer.
        cover_fraction, feature_size_m, optical_depth, thickness_m, heading_deg: see `CloudLayer`.
        height_above_camera_m: see `CloudLayer`.
    """

    kind: CloudKind = "cumulus"
    scene_fraction: Fraction = 0.0
    cover_fraction: Range = Range(low=0.15, high=0.55)
    height_above_camera_m: Range = Range(low=800, high=3000)
    thickness_m: Range = Range(low=300, high=900)
    feature_size_m: Range = Range(low=1500, high=4000)
    optical_depth: Range = Range(low=4, high=14)
    heading_deg: Range = Range(low=-180, high=180)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        height = self.height_above_camera_m
        height.within(-15000, 15000, "height_above_camera_m")
        if height.low < 100 and height.high > -100:
            raise ValueError("height_above_camera_m: the whole range must lie above 100 m or below -100 m")
        if self.kind == "rain" and height.low < 0:
            raise ValueError("height_above_camera_m: rain must end above the camera")
        self.cover_fraction.within(0, 1, "cover_fraction")
        self.thickness_m.within(LEAST_THICKNESS_M, 5000, "thickness_m")
        self.feature_size_m.within(10, 1e5, "feature_size_m")
        self.optical_depth.within(0.01, 200, "optical_depth")
        self.heading_deg.within(-360, 360, "heading_deg")
        return self


class MistRanges(FrozenModel):
    """Distribution of mist around the camera.

    Attributes:
        scene_fraction: share of scenes in mist.
        visibility_m, above_m, below_m, patchiness: see `Mist`.
    """

    scene_fraction: Fraction = 0.0
    visibility_m: Range = Range(low=80, high=600)
    above_m: Range = Range(low=50, high=400)
    below_m: Range = Range(low=50, high=400)
    patchiness: Range = Field(default=Range(low=0, high=0), exclude_if=lambda patchiness: patchiness.high == 0)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.visibility_m.within(10, 100_000, "visibility_m")
        self.above_m.within(0.1, 10_000, "above_m")
        self.below_m.within(0.1, 10_000, "below_m")
        self.patchiness.within(0, 1, "patchiness")
        return self


class MoonRanges(FrozenModel):
    """Distribution of the moon.

    Attributes:
        scene_fraction: share of scenes with a moon.
        elevation_deg, azimuth_deg, phase_angle_deg: see `Moon`.
    """

    scene_fraction: Fraction = 0.0
    elevation_deg: Range = Range(low=10, high=60)
    azimuth_deg: Range = Range(low=-180, high=180)
    phase_angle_deg: Range = Range(low=0, high=90)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.elevation_deg.within(-90, 90, "elevation_deg")
        self.azimuth_deg.within(-360, 360, "azimuth_deg")
        self.phase_angle_deg.within(0, 180, "phase_angle_deg")
        return self


class EnvironmentMapRanges(EnvironmentMapFile):
    """Distribution of a scene's environment map.

    Attributes:
        rotation_deg: see `EnvironmentMap`.
    """

    rotation_deg: Range = Range(low=0, high=0)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.rotation_deg.within(-360, 360, "rotation_deg")
        return self


class EnvironmentRanges(FrozenModel):
    """Distribution of each scene's environment; units and meaning as in `Environment`.

    Attributes:
        ground: kinds to choose from; a kind that is listed twice is twice as likely. TOML also takes a single name.
        clouds: layers, each drawn independently; in TOML one table or an array of them.
        mist, moon: with the share of the scenes that have them.
        map: an image of sky and ground, which replaces all of the above but the visibility; in TOML the path of a file
            in absolute units, or a table with `file` and the other keys of `EnvironmentMapRanges`.
        sky_model: see `Environment`. All scenes have the one given.
    """

    sun_elevation_deg: Range = Range(low=15, high=65)
    sun_azimuth_deg: Range = Range(low=-180, high=180)
    turbidity: Range = Range(low=2.2, high=4)
    visibility_m: Range = Range(low=20_000, high=80_000)
    altitude_m: Range = Range(low=1500, high=6000)
    ground: tuple[GroundKind, ...] = Field(default=("sea", "forest", "fields", "dry"), min_length=1, max_length=40)
    wind_speed_m_s: Range = Range(low=3, high=11)
    clouds: tuple[Clouds, ...] = Field(default=(Clouds(),), max_length=6)
    mist: MistRanges = MistRanges()
    moon: MoonRanges = MoonRanges()
    map: EnvironmentMapRanges | None = None
    sky_model: SkyModel = Field(default="daylight", exclude_if=lambda model: model == "daylight")

    @field_validator("ground", mode="before")
    @classmethod
    def _one_ground(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value

    @field_validator("clouds", mode="before")
    @classmethod
    def _one_layer(cls, value: object) -> object:
        return (value,) if isinstance(value, dict | Clouds) else value

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.sun_elevation_deg.within(-90, 90, "sun_elevation_deg")
        self.sun_azimuth_deg.within(-360, 360, "sun_azimuth_deg")
        self.turbidity.within(1.9, 10, "turbidity")
        self.visibility_m.within(500, 400_000, "visibility_m")
        self.altitude_m.within(10, 20_000, "altitude_m")
        self.wind_speed_m_s.within(0, 40, "wind_speed_m_s")
        if self.map is not None and self.sky_model != "daylight":
            raise ValueError("sky_model: a map replaces the sky; leave out one of the two")
        for layer in self.clouds:
            highest_m = layer.height_above_camera_m.high
            if layer.scene_fraction > 0 and self.altitude_m.high + highest_m < LEAST_THICKNESS_M:
                raise ValueError(
                    f"clouds: height_above_camera_m up to {highest_m:g} is always in the ground with altitude_m up to "
                    f"{self.altitude_m.high:g}"
                )
        return self
