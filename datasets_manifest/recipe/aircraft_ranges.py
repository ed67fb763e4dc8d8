"""The sections of a recipe about aircraft: `[tanker]`, `[hose]` of single frames, `[neighbours]`, and `[receiver]`."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from datasets_manifest.recipe.sequence_ranges import Hose
from datasets_manifest.types.field_types import Fraction, Range
from drogue_models.frozen_model import FrozenModel
from drogue_models.obstacles import ProbeForm
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
        station: where the hose leaves; without it, all stations of the type have equal shares.
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
        roughness: width of the distribution of the satin surface's facets.
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


class NeighbourRanges(FrozenModel):
    """Distribution of second drogues, of the scene's own kind, with hoses as `[hose]` has them.

    The second drogue hangs from another station of the first tanker, if that is the plain wing, or behind another
    tanker on the same heading. It is farther away than the one that is sought, and does not lie behind it in the image.

    Attributes:
        scene_fraction: share of scenes with a second drogue in view.
        distance_fraction: its distance along the optical axis over that of the drogue that is sought.
        same_tanker_fraction: share of these scenes in which its hose comes from another station of the first tanker, if
            that keeps it in view.
        station_m: distance of that station from the first hose, along the wing. [m]
    """

    scene_fraction: Fraction = 0.25
    distance_fraction: Range = Range(low=1.2, high=3.0)
    same_tanker_fraction: Fraction = 0.5
    station_m: Range = Range(low=3.0, high=12.0)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        # The sought one stays the nearest, so that it can be told.
        self.distance_fraction.within(1.15, 20, "distance_fraction")
        self.station_m.within(1.5, 60, "station_m")
        return self


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
        probes: forms to choose from with equal probability, or `none`; one may be listed several times. The page on
            [surroundings](surroundings.md#receiver) shows what each is.
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
