"""Dimensions of the bodies of drogues other than the flat ring: baskets, metal leaves, ribbons and printed cones.

A body is spread along a line from the coupling to the rim, turned around the axis. Sizes, with what is public about
them:

* Baskets. Spring struts on a ring around the coupling carry a canopy near the mouth and open in the air stream; cords
  join neighbouring struts (M. Bandak, Paradrogue assembly, US 6,464,173 B1, 2002; Flight Refuelling Ltd, A drogue
  assembly for in-flight refuelling, EP 0 964 816 B1, 1998; Air refueling drogue, US 6,375,123 B1, 2002, which asks for
  a bell shape). Tankers carry a large basket for helicopters, up to 130 knots, and a smaller one for faster aircraft
  (Cobham Mission Systems, Air-to-air refuelling drogue assembly, EP 2 484 592 A1, 2012). None of them gives sizes in
  metres: 24 to 36 struts and rims of 0.45 to 0.85 m are our choice, around the seed paper's 0.66 m.
* Ribbons. Rings of ribbon with open slots between them; the slots of conical ribbon parachutes are 15 to 35 % of the
  surface (T. W. Knacke, Parachute Recovery Systems Design Manual, NWC TP 6575, 1991, chapter 5).
* Leaves of sheet metal that overlap like those of a flower, with openings at their roots for the air. Number, width and
  overlap are our choice.
* Cones printed in plastic, 0.20 to 0.35 m wide, for docking experiments of small unmanned aircraft; a nozzle of 0.4 mm
  prints walls of whole multiples of that width. Sizes are our choice.

A drogue may have lamps, or paint that a lamp on the probe lights (SAE ARP694, Aerial refueling lights; ATP-3.3.4.7 on
signal lights of hose-and-drogue systems); how many and how bright is our choice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel, Metres, ReflectanceRgb

SmallLength = Annotated[float, Field(gt=0, le=0.2, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]

# Silver-white sheeting by daylight: paint and glass beads scatter about two thirds of the light (our choice).
SHEETING: ReflectanceRgb = (0.62, 0.63, 0.62)


class Canopy(FrozenModel):
    """Cloth around the struts near the mouth.

    Attributes:
        style: `pleated` cloth that billows between the struts and lies in folds; `segmented` pieces with gaps at some
            struts; a `smooth` band; or an inflated `tube` around the mouth.
        length_m: along the struts, from the mouth; of a tube its diameter. [m]
        billow_m: largest distance between cloth and the chord over two struts, of a pleated or segmented canopy. [m]
        folds_per_strut: folds of a pleated canopy between two struts.
        fold_depth_m: of the folds. [m]
        segment_count: pieces of a segmented canopy.
        gap_fraction: of a segmented canopy's circumference.
    """

    style: Literal["pleated", "segmented", "smooth", "tube"] = "pleated"
    length_m: SmallLength = 0.10
    billow_m: Annotated[float, Field(ge=0, le=0.05)] = 0.012
    folds_per_strut: int = Field(default=3, ge=1, le=6)
    fold_depth_m: Annotated[float, Field(ge=0, le=0.02)] = 0.004
    segment_count: int = Field(default=12, ge=2, le=96)
    gap_fraction: Annotated[float, Field(gt=0, le=0.6)] = 0.12


class Stripes(FrozenModel):
    """A second paint on the canopy.

    Attributes:
        reflectance_rgb: of the second paint.
        count: stripes of it.
        across: whether the stripes run around the axis instead of along it.
        share: of the canopy that has the second paint.
    """

    reflectance_rgb: ReflectanceRgb
    count: int = Field(default=8, ge=1, le=48)
    across: bool = False
    share: Annotated[float, Field(gt=0, lt=1)] = 0.5


class ReflectorTape(FrozenModel):
    """Bands of reflecting tape around canopy and coupling.

    Attributes:
        canopy_bands: on the canopy.
        coupling_bands: on the coupling's body.
        width_fraction: of the canopy's or coupling's length that the bands take.
        reflectance_rgb: by daylight.
    """

    canopy_bands: int = Field(default=1, ge=0, le=4)
    coupling_bands: int = Field(default=1, ge=0, le=4)
    width_fraction: Annotated[float, Field(gt=0, le=0.6)] = 0.2
    reflectance_rgb: ReflectanceRgb = SHEETING


class RimLamps(FrozenModel):
    """Small round lamps inside the rim.

    Attributes:
        count: evenly spaced, the first on the +y axis.
        radius_m: of each. [m]
        luminance_cd_m2: 0 for lamps that are off. [cd/m2]
        emission_rgb: colour of their light; scaled so that its luminance is 1.
        reflectance_rgb: of their glass.
    """

    count: int = Field(default=12, ge=1, le=48)
    radius_m: Annotated[float, Field(ge=0.002, le=0.03)] = 0.007
    luminance_cd_m2: float = Field(default=0.0, ge=0, le=1e6)
    emission_rgb: ReflectanceRgb = (1.0, 0.85, 0.6)
    reflectance_rgb: ReflectanceRgb = (0.45, 0.44, 0.40)

    @model_validator(mode="after")
    def _shines_in_a_colour(self) -> Self:
        if self.luminance_cd_m2 > 0 and max(self.emission_rgb) == 0:
            raise ValueError("emission_rgb: lamps that are lit need a colour above 0")
        return self

    @property
    def radiance_rgb(self) -> tuple[float, float, float]:
        """Radiance of the lamps, 0 where they are off. [cd/m2]"""
        red, green, blue = self.emission_rgb
        # Luminance of linear Rec. 709 (ITU-R BT.709).
        unit = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        scale = self.luminance_cd_m2 / unit if self.luminance_cd_m2 else 0.0
        return red * scale, green * scale, blue * scale


class ReceptionCoupling(FrozenModel):
    """The mouth of the coupling, which takes the probe's nozzle.

    The nozzle of STANAG 3447 passes a hose of 67 mm; that the throat is a little wider is our choice.

    Attributes:
        throat_radius_m: of the bore for the nozzle. [m]
        guide_length_m: of the cone that leads to the bore. [m]
        roller_count: housings of the latching rollers around the body.
        bolt_count: heads on the flange.
    """

    throat_radius_m: SmallLength = 0.037
    guide_length_m: SmallLength = 0.06
    roller_count: int = Field(default=6, ge=0, le=16)
    bolt_count: int = Field(default=12, ge=0, le=36)


class _Body(FrozenModel):
    """What all bodies have.

    Attributes:
        depth_m: of the coupling's front behind the rim plane. [m]
        flare: 0 for a straight cone; positive opens towards the mouth like a trumpet, negative like a bell.
        coupling, lamps, tape, stripes: as their types say, or none.
    """

    depth_m: Metres = 0.28
    flare: float = Field(default=0.0, ge=-0.9, le=0.9)
    coupling: ReceptionCoupling = ReceptionCoupling()
    lamps: RimLamps | None = None
    tape: ReflectorTape | None = None
    stripes: Stripes | None = None

    @property
    def reach_m(self) -> float:
        """How far cloth, leaves or walls stand outside the body's line at most. [m]"""
        return 0.008


class BasketBody(_Body):
    """Struts with a canopy near the mouth.

    Attributes:
        strut_width_m, strut_root_width_m: at the mouth and at the coupling. [m]
        strut_thickness_m: [m]
        canopy: the cloth.
        cord_rings: rings of cord from strut to strut behind the canopy; many of them are a net.
    """

    family: Literal["basket"] = "basket"
    strut_width_m: SmallLength = 0.010
    strut_root_width_m: SmallLength = 0.014
    strut_thickness_m: SmallLength = 0.003
    canopy: Canopy = Canopy()
    cord_rings: int = Field(default=2, ge=0, le=16)

    @property
    def reach_m(self) -> float:
        """See the base class. [m]"""
        canopy = self.canopy
        cloth_m = canopy.length_m if canopy.style == "tube" else canopy.billow_m + canopy.fold_depth_m + 0.003
        return self.strut_thickness_m / 2 + cloth_m


class PetalBody(_Body):
    """Overlapping leaves of sheet metal; `rib_count` of them.

    Attributes:
        sheet_m: thickness. [m]
        overlap_fraction: of a leaf's width at the mouth that lies over its neighbour.
        root_fraction: width of a leaf at the coupling over the space that it has there; the rest is open.
        tip_m: how far a leaf's corners stand behind its tip. [m]
    """

    family: Literal["petals"] = "petals"
    sheet_m: Annotated[float, Field(ge=5e-4, le=5e-3)] = 0.0012
    overlap_fraction: Annotated[float, Field(ge=0.02, le=0.4)] = 0.15
    root_fraction: Annotated[float, Field(ge=0.2, le=0.95)] = 0.6
    tip_m: Annotated[float, Field(ge=0, le=0.04)] = 0.010

    @property
    def reach_m(self) -> float:
        """See the base class. [m]"""
        return 2 * self.sheet_m + self.tip_m


class RibbonBody(_Body):
    """Rings of ribbon on radial straps, with slots between the rings.

    Attributes:
        ribbon_count: rings.
        slot_fraction: of the ribbons' length along the straps that is open.
        covered_fraction: of the straps that have ribbons, from the mouth.
        strap_width_m: [m]
        billow_m: see `Canopy`. [m]
    """

    family: Literal["ribbons"] = "ribbons"
    ribbon_count: int = Field(default=6, ge=2, le=12)
    slot_fraction: Annotated[float, Field(ge=0.15, le=0.45)] = 0.28
    covered_fraction: Annotated[float, Field(ge=0.3, le=0.9)] = 0.75
    strap_width_m: SmallLength = 0.020
    billow_m: Annotated[float, Field(ge=0, le=0.03)] = 0.010

    @property
    def reach_m(self) -> float:
        """See the base class. [m]"""
        return self.billow_m + 0.005


class ConeBody(_Body):
    """A printed cone with windows.

    Attributes:
        wall_m: thickness. [m]
        window_count: around the axis, 0 for a closed cone.
        window_rows: along the cone.
        web_fraction: of the circumference between windows.
    """

    family: Literal["cone"] = "cone"
    depth_m: Metres = 0.12
    wall_m: Annotated[float, Field(ge=8e-4, le=6e-3)] = 0.0024
    window_count: int = Field(default=12, ge=0, le=36)
    window_rows: int = Field(default=2, ge=1, le=4)
    web_fraction: Annotated[float, Field(ge=0.1, le=0.8)] = 0.3


BODY_FAMILIES = ("basket", "petals", "ribbons", "cone")
DrogueBody = Annotated[BasketBody | PetalBody | RibbonBody | ConeBody, Field(discriminator="family")]


@dataclass(frozen=True)
class BodyLine:
    """The line from rim to coupling around which a body is built.

    Attributes:
        front_m, back_m: (radius, z) of its ends. [m]
        flare: see the bodies.
    """

    front_m: tuple[float, float]
    back_m: tuple[float, float]
    flare: float

    def radius_m(self, z_m: float) -> float:
        """Radius at a depth; that of the nearer end beyond the line. [m]"""
        (front, low), (back, high) = self.front_m, self.back_m
        share = min(max((high - z_m) / (high - low), 0.0), 1.0)
        return back + (front - back) * share * (1.0 - self.flare * (1.0 - share))

    def length_m(self, shares: int = 64) -> float:
        """Length of the line. [m]"""
        low, high = self.front_m[1], self.back_m[1]
        depths = [low + (high - low) * step / shares for step in range(shares + 1)]
        places = [(self.radius_m(depth), depth) for depth in depths]
        return sum(math.dist(*pair) for pair in pairwise(places))
