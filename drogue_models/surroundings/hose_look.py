"""The paint of a hose: rubber with bands that mark where fuel flows, grime, and a satin surface."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel, ReflectanceRgb


class HoseBand(FrozenModel):
    """A painted band around a hose.

    Attributes:
        start_m, end_m: distance of its ends from the coupling, along the hose. [m]
        reflectance_rgb: diffuse reflectance in linear Rec. 709.
    """

    start_m: float = Field(ge=0, le=100)
    end_m: float = Field(ge=0, le=100)
    reflectance_rgb: ReflectanceRgb

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.start_m >= self.end_m:
            raise ValueError(f"start_m: must be below end_m, {self.end_m:g} m, got {self.start_m:g}")
        return self


class HoseLook(FrozenModel):
    """What a hose's surface looks like.

    Attributes:
        reflectance_rgb: of the rubber, diffuse, in linear Rec. 709.
        bands: painted on it.
        sheen_fraction: share of the light that its satin surface mirrors; matt at 0.
        roughness: of the satin surface, see `SatinPaint`.
        seed: of the grime's pattern.
    """

    reflectance_rgb: ReflectanceRgb
    bands: tuple[HoseBand, ...] = ()
    sheen_fraction: float = Field(default=0.0, ge=0, le=0.5)
    roughness: float = Field(default=0.3, ge=0.05, le=1)
    seed: int = Field(default=0, ge=0)
