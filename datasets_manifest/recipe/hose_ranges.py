"""The `[hose]` section of a recipe: length, hang and paint of the hose of single frames."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from datasets_manifest.recipe.sequence_ranges import Hose
from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel

_HANG_KEYS = (
    "model",
    "length_m",
    "drop_deg",
    "swing_deg",
    "airspeed_m_s",
    "trailed_scene_fraction",
    "retracted_scene_fraction",
    "retracted_length_m",
)


class HoseRanges(FrozenModel):
    """Distribution of the hoses: length and paint by scene, drop and swing by frame.

    A hose is retracted, fully trailed, or as long as drawn from `length_m`. It takes its diameter from the drogue.

    Attributes:
        model: weights, drag and air density: preset, table or all parameters, see `HoseParameters`. Its own length is
            not used; its weights and the drogue's drag are scaled to the sizes of hose and rim.
        length_m: from the tanker to the coupling, neither retracted nor fully trailed. [m]
        drop_deg: angle of the coupling below the tanker's exit. [deg]
        swing_deg: angle of the coupling to the right of the exit. [deg]
        airspeed_m_s: within it the air stream is as fast as the drop needs. [m/s]
        trailed_scene_fraction: share of scenes with a fully trailed hose, as long as the high end of `length_m`.
        retracted_scene_fraction: share of scenes in which the drogue waits just behind the exit.
        retracted_length_m: length of the retracted hose. [m]
        banded_scene_fraction: share of scenes whose hose has painted bands.
        reflectance: of the hose's rubber.
        sheen_fraction: share of the light that the rubber's satin surface mirrors; matt at 0.
        roughness: of the satin surface, see `SatinPaint`.
    """

    model: Hose = Field(default="full-size", validate_default=True)
    length_m: Range = Range(low=5, high=25)
    drop_deg: Range = Range(low=5, high=20)
    swing_deg: Range = Range(low=-3, high=3)
    airspeed_m_s: Range = Range(low=80, high=200)
    trailed_scene_fraction: Fraction = 0.3
    retracted_scene_fraction: Fraction = 0.1
    retracted_length_m: Range = Range(low=0.15, high=0.4)
    banded_scene_fraction: Fraction = 0.6
    reflectance: Range = Range(low=0.02, high=0.07)
    sheen_fraction: Range = Range(low=0.0, high=0.06)
    roughness: Range = Range(low=0.25, high=0.5)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.length_m.within(2, 40, "length_m")
        self.drop_deg.within(0, 40, "drop_deg")
        self.swing_deg.within(-20, 20, "swing_deg")
        self.retracted_length_m.within(0.1, 1, "retracted_length_m")
        self.airspeed_m_s.within(10, 300, "airspeed_m_s")
        self.reflectance.within(0.01, 0.95, "reflectance")
        self.sheen_fraction.within(0, 0.5, "sheen_fraction")
        self.roughness.within(0.05, 1, "roughness")
        if self.trailed_scene_fraction + self.retracted_scene_fraction > 1:
            raise ValueError(
                "trailed_scene_fraction, retracted_scene_fraction: must add up to at most 1, got "
                f"{self.trailed_scene_fraction:g} and {self.retracted_scene_fraction:g}"
            )
        return self

    def check_sequence(self) -> None:
        """Check that no key is set that a recipe with `[sequence]` does not use.

        Raises:
            ValueError: one is; names it.
        """
        plain = HoseRanges()
        for name in _HANG_KEYS:
            if getattr(self, name) != getattr(plain, name):
                raise ValueError(f"hose.{name}: in a recipe with [sequence] the simulated hose decides; leave it out")
