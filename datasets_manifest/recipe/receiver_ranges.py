"""The `[receiver]` section of a recipe: which probe the receiver has, where it is, and what else of it is in view."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel
from drogue_models.obstacles import ProbeForm

ProbeSide = Literal["left", "right", "centre"]
_PROBES: tuple[ProbeForm | Literal["none"], ...] = (
    "probe-straight",
    "probe-cranked",
    "probe-retractable",
    "probe-nose",
    "probe-boom",
    "none",
)


class ReceiverRanges(FrozenModel):
    """Distribution of the receivers, drawn by scene.

    In sequences the probe's tip stays at the rig's `probe_tip_body_m`, which the receiver docks with, so that `sides`,
    `tip_fraction` and `jitter_m` do not apply.

    Attributes:
        probes: forms to choose from with equal probability, see `drogue_models.surroundings.probes`, or `none`; a form
            may be listed several times.
        sides: to choose from with equal probability, except that `probe-nose` is always at the centre. The rig's
            `probe_tip_body_m` gives the distances from the middle; at the centre that to the side is 0.
        tip_fraction: factors on the tip's distances to the side and down, each drawn. Receivers differ in them.
        jitter_m: largest deviation of the tip along each axis. [m]
        jitter_deg: largest turn of the probe about each axis. [deg]
        probe_radius_m: of its tube. [m]
        nose_scene_fraction: share of scenes with the receiver's nose at the lower edge of the view.
        canopy_scene_fraction: share of scenes with the frame of its windscreen around the view.
        glare_shield_scene_fraction: share of scenes with the instruments' glare shield at the lower edge of the view.
            A scene has a nose or a glare shield, not both.
    """

    probes: tuple[ProbeForm | Literal["none"], ...] = Field(default=_PROBES, min_length=1, max_length=40)
    sides: tuple[ProbeSide, ...] = Field(default=("left", "right", "right", "centre"), min_length=1, max_length=40)
    tip_fraction: Range = Range(low=0.6, high=1.4)
    jitter_m: float = Field(default=0.05, ge=0, le=0.5)
    jitter_deg: float = Field(default=2.5, ge=0, le=15)
    probe_radius_m: Range = Range(low=0.034, high=0.046)
    nose_scene_fraction: Fraction = 0.2
    canopy_scene_fraction: Fraction = 0.15
    glare_shield_scene_fraction: Fraction = 0.15

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.tip_fraction.within(0.2, 3, "tip_fraction")
        self.probe_radius_m.within(0.01, 0.2, "probe_radius_m")
        if self.nose_scene_fraction + self.glare_shield_scene_fraction > 1:
            raise ValueError(
                "nose_scene_fraction, glare_shield_scene_fraction: must add up to at most 1, got "
                f"{self.nose_scene_fraction:g} and {self.glare_shield_scene_fraction:g}"
            )
        return self
