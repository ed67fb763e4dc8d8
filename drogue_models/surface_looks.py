"""What frames choose of surfaces' looks: how worn all of them are, and the paint of a hose."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel, ReflectanceRgb


class SurfaceWear(FrozenModel):
    """Wear of a drogue in use; every share is 0 for none and 1 for the most that is seen in service.

    Attributes:
        seed: of all patterns.
        soot: dark film of exhaust and dust in clouds and streaks.
        oil: streaks of hydraulic fluid and fuel from the coupling along the flow.
        edge_wear: paint rubbed through to bare metal along edges and where probes touch.
        fading: bleached, chalky paint in clouds.
        stitching: contrast of seams and stitches of fabric, of rivets and screws of metal.
        tape: strips of worn tape around struts and tubes.
    """

    seed: int = Field(ge=0, lt=2**31)
    soot: float = Field(default=0.3, ge=0, le=1)
    oil: float = Field(default=0.2, ge=0, le=1)
    edge_wear: float = Field(default=0.3, ge=0, le=1)
    fading: float = Field(default=0.3, ge=0, le=1)
    stitching: float = Field(default=0.5, ge=0, le=1)
    tape: float = Field(default=0.0, ge=0, le=1)


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
