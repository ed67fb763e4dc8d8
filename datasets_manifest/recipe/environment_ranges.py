"""From what the environments of a recipe's scenes are drawn."""

from __future__ import annotations

from typing import Self

from pydantic import Field, field_validator, model_validator

from datasets_manifest.recipe.weather_ranges import Clouds, MistRanges, MoonRanges
from datasets_manifest.types.environment_map import MapRanges
from datasets_manifest.types.ground import GroundKind
from datasets_manifest.types.ranges import Range
from drogue_models.frozen_model import FrozenModel


class EnvironmentRanges(FrozenModel):
    """From what each scene's environment is drawn; units and meaning as in `Environment`.

    Attributes:
        ground: kinds that are drawn from, each as often as it is named; in TOML also a single name.
        clouds: layers, each drawn for itself; in TOML one table or an array of them.
        mist, moon: where a scene has them.
        map: a picture of sky and ground, which takes the place of all the others but the visibility; in TOML the path
            of a file in absolute units, or a table with `file` and the other keys of `MapRanges`.
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
    map: MapRanges | None = None

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
        return self
