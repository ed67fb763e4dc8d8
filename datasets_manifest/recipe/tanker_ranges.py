"""The `[tanker]` section of a recipe: types of tankers, their paints, flaps and lamps, and the line of a multirotor."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel
from drogue_models.tankers.tanker import STATIONS, PaintScheme, PodLight, Station, TankerType

LONGEST_LINE_M = 5.0


class PaintShare(FrozenModel):
    """One of several paints.

    Attributes:
        scheme: its name.
        weight: relative to the other paints' weights.
    """

    scheme: PaintScheme
    weight: float = Field(default=1.0, gt=0, le=1e6)


_MILITARY_PAINTS: tuple[PaintShare, ...] = (
    PaintShare(scheme="light-grey", weight=3),
    PaintShare(scheme="medium-grey", weight=3),
    PaintShare(scheme="white-cheat-line", weight=2),
    PaintShare(scheme="dark-grey", weight=2),
    PaintShare(scheme="navy", weight=2),
    PaintShare(scheme="olive"),
    PaintShare(scheme="desert"),
    PaintShare(scheme="trainer"),
)
_USUAL_PAINTS: dict[TankerType, tuple[PaintShare, ...]] = {
    "fighter": (PaintShare(scheme="navy", weight=3), PaintShare(scheme="medium-grey"), PaintShare(scheme="dark-grey")),
    "unmanned": (PaintShare(scheme="navy", weight=2), PaintShare(scheme="light-grey"), PaintShare(scheme="trainer")),
    "multirotor": (PaintShare(scheme="carbon", weight=4), PaintShare(scheme="trainer"), PaintShare(scheme="dark-grey")),
}


class TankerVariant(FrozenModel):
    """One of several tankers of a dataset.

    Attributes:
        type: planform.
        station: where the hose leaves; None for all of the type in equal shares.
        weight: its share of the scenes, relative to the other variants' weights.
        paints: to choose from; empty for the section's, or for the usual ones of the type.
    """

    type: TankerType
    station: Station | None = None
    weight: float = Field(default=1.0, gt=0, le=1e6)
    paints: tuple[PaintShare, ...] = ()

    @model_validator(mode="after")
    def _has_station(self) -> Self:
        if self.station is not None and self.station not in STATIONS[self.type]:
            raise ValueError(f"station: {self.type} has {', '.join(STATIONS[self.type])}, got {self.station!r}")
        return self

    @property
    def stations(self) -> tuple[Station, ...]:
        """Stations to choose from."""
        return STATIONS[self.type] if self.station is None else (self.station,)


class TankerRanges(FrozenModel):
    """Distribution of each scene's tanker.

    Attributes:
        variants: to choose from by scene.
        paints: of variants without their own; empty for the usual ones of each type.
        flaps_deg: deflection of the flaps. [deg]
        nav_light_scene_fraction: share of scenes whose navigation lights shine.
        pod_lights: lamps at the hose's exit, one of which shines; each as likely as the others. A lamp may be listed
            several times.
        line_m: length of a multirotor's line between belly and coupling. [m]
        line_drop_deg: of the coupling below the multirotor's belly. [deg]
    """

    variants: tuple[TankerVariant, ...] = Field(min_length=1)
    paints: tuple[PaintShare, ...] = ()
    flaps_deg: Range = Range(low=0, high=20)
    nav_light_scene_fraction: Fraction = 0.5
    pod_lights: tuple[PodLight, ...] = Field(default=("off", "red", "amber", "green"), min_length=1)
    line_m: Range = Range(low=1, high=LONGEST_LINE_M)
    line_drop_deg: Range = Range(low=15, high=50)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        self.flaps_deg.within(0, 40, "flaps_deg")
        self.line_m.within(0.5, LONGEST_LINE_M, "line_m")
        self.line_drop_deg.within(5, 85, "line_drop_deg")
        return self

    def paints_of(self, variant: TankerVariant) -> tuple[PaintShare, ...]:
        """Paints of a variant: its own, or the section's, or the usual ones of its type."""
        return variant.paints or self.paints or _USUAL_PAINTS.get(variant.type, _MILITARY_PAINTS)

    def check_hose(self, length_m: float) -> None:
        """Check that a sequence's hose fits all variants.

        Raises:
            ValueError: a multirotor would carry a hose as of an aeroplane.
        """
        if length_m > LONGEST_LINE_M and any(variant.type == "multirotor" for variant in self.variants):
            raise ValueError(
                f"tanker.variants: a multirotor carries at most {LONGEST_LINE_M:g} m of hose, and sequence.hose has "
                f'{length_m:g} m; set sequence.hose to "small-uav", or leave the multirotor out'
            )
