"""The `[target]` section of a recipe: which drogues, in which state, and what else is in the picture."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.types.ranges import Fraction, Range
from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import DrogueParameters

CONSTANT_ONE = Range(low=1, high=1)

DistractorForm = Literal["ball", "disc", "ring"]
_ALL_FORMS: tuple[DistractorForm, ...] = ("ball", "disc", "ring")


class DrogueVariant(FrozenModel):
    """One of several drogues of a dataset.

    Attributes:
        drogue: in TOML the name of a preset or a TOML file.
        weight: its share of the scenes, against the other variants' weights.
    """

    drogue: DrogueParameters
    weight: float = Field(default=1.0, gt=0, le=1e6)


class TargetRanges(FrozenModel):
    """From what each scene's target is drawn; the defaults give a drogue as new that is alone in the picture.

    Attributes:
        variants: drogues to choose from by scene; empty for the recipe's own.
        missing_marker_fraction: chance of each marker to have come off; three always stay.
        marker_reflectance_fraction: what is left of each marker's and the hub's paint, see `SurfaceCondition`.
        dirty_marker_fraction: chance of each marker and of the hub to be dirty.
        dirt_fraction: share of a dirty surface under dirt.
        failed_lamp_fraction: chance of each self-lit marker to be out.
        lamp_fraction: luminance of the others, as a share of the drogue's.
        body_reflectance_fraction: see `DrogueCondition`.
        probe: whether the receiver's probe is drawn, with its tip where the rig says.
        probe_radius_m: of its tube. [m]
        obstacle_frame_fraction: share of frames in which a bar close to the cameras may hide part of the drogue.
        distractor_frame_fraction: share of frames with other round things; in frames without a drogue they are the
            hard negatives.
        distractor_forms: from which each is chosen with equal chances; a form may stand in it several times.
    """

    variants: tuple[DrogueVariant, ...] = ()
    missing_marker_fraction: Fraction = 0.0
    marker_reflectance_fraction: Range = CONSTANT_ONE
    dirty_marker_fraction: Fraction = 0.0
    dirt_fraction: Range = Range(low=0.05, high=0.4)
    failed_lamp_fraction: Fraction = 0.0
    lamp_fraction: Range = CONSTANT_ONE
    body_reflectance_fraction: Range = CONSTANT_ONE
    probe: bool = False
    probe_radius_m: float = Field(default=0.04, gt=0, le=0.5)
    obstacle_frame_fraction: Fraction = 0.0
    distractor_frame_fraction: Fraction = 0.0
    distractor_forms: tuple[DistractorForm, ...] = Field(
        default=_ALL_FORMS, min_length=1, exclude_if=lambda forms: forms == _ALL_FORMS
    )

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.marker_reflectance_fraction.within(0, 1, "marker_reflectance_fraction")
        self.dirt_fraction.within(0, 1, "dirt_fraction")
        self.lamp_fraction.within(0, 1, "lamp_fraction")
        self.body_reflectance_fraction.within(0.1, 3, "body_reflectance_fraction")
        return self
