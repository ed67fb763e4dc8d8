"""Dimensions and surface properties of a drogue, from a preset or a user's TOML file.

Drogue frame: origin at the centre of the rim circle, x and y in the rim plane, z along the axis from the mouth to the
hose.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drogue_models.bodies import BodyLine, DrogueBody
from drogue_models.frozen_model import FrozenModel, Metres, ReflectanceRgb

Depth = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
PlanePoint = tuple[
    Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)],
    Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)],
]

RED_PAINT: ReflectanceRgb = (0.55, 0.03, 0.03)  # our choice: a saturated signal red
WHITE_PAINT: ReflectanceRgb = (0.80, 0.80, 0.80)  # fresh white paint reflects 0.8 in the visible
MATT_BLACK: ReflectanceRgb = (0.03, 0.03, 0.03)


class HubParameters(FrozenModel):
    """The bright annulus around the coupling's mouth.

    Attributes:
        depth_m: distance of its face behind the rim plane. [m]
        inner_radius_m, outer_radius_m: of its two edges. [m]
        reflectance_rgb: diffuse reflectance in linear Rec. 709.
    """

    depth_m: Metres = 0.25  # our choice within 0.20-0.35 m of the basket depth of published drogues
    inner_radius_m: Metres = 0.05
    outer_radius_m: Metres = 0.075
    reflectance_rgb: ReflectanceRgb = RED_PAINT

    @model_validator(mode="after")
    def _edges_in_order(self) -> Self:
        if self.inner_radius_m >= self.outer_radius_m:
            raise ValueError(f"inner_radius_m: must be below outer_radius_m ({self.outer_radius_m} m)")
        return self


class BodyMesh(FrozenModel):
    """A user's mesh that replaces canopy, ribs and coupling, pinned by its hash.

    Attributes:
        path: as the user wrote it, relative to `folder` unless absolute.
        sha256: of the file.
        folder: that of the drogue's TOML file. It is not stored with a dataset, whose contents must not depend on the
            place where it was made; a drogue that is read back takes the dataset's copy, else looks in the working
            directory.
    """

    path: str = Field(min_length=1, max_length=1000)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    folder: Path = Field(default=Path(), exclude=True)

    def __eq__(self, other: object) -> bool:
        """Whether name and contents are the same, in whatever folder."""
        return isinstance(other, BodyMesh) and (self.path, self.sha256) == (other.path, other.sha256)

    def __hash__(self) -> int:
        """Of name and contents."""
        return hash((self.path, self.sha256))

    @property
    def file(self) -> Path:
        """Path of the mesh."""
        return self.folder / self.path

    @property
    def file_type(self) -> str:
        """Ending of its name in lower case, such as `ply`."""
        return self.file.suffix.lower().removeprefix(".")


class SatinPaint(FrozenModel):
    """Rough plastic: microfacets reflect a fixed share of the light, and the paint below scatters the rest.

    The facets are those of Trowbridge and Reitz (GGX; B. Walter et al., EGSR 2007, doi:10.2312/EGWR/EGSR07/195-206).

    Attributes:
        parts: the parts with this paint; markers, face, rim and hub are always matt.
        sheen_fraction: share that the facets reflect.
        roughness: width of the facets' distribution.
    """

    parts: tuple[Literal["canopy", "ribs", "coupling"], ...] = Field(min_length=1)
    sheen_fraction: float = Field(default=0.05, gt=0, le=0.5)  # our choice, near what varnish mirrors head on, 0.04
    roughness: float = Field(default=0.25, ge=0.05, le=1.0)


class MarkerCode(FrozenModel):
    """How self-lit markers blink, each in a rhythm of its own, so that equal lamps can be told apart.

    Attributes:
        slot_s: how long a lamp stays lit or dark at least. [s]
        patterns: of each marker, or one for all: its slots in turn, `1` lit and `0` dark, repeated without end. Time
            zero of the images' time stamps is in the middle of the first.
    """

    slot_s: float = Field(ge=1e-4, le=60)
    patterns: tuple[Annotated[str, Field(pattern=r"^[01]*1[01]*$", max_length=256)], ...] = Field(
        min_length=1, max_length=32
    )

    def lit_fractions(self, time_s: float, exposure_s: float) -> tuple[float, ...]:
        """For each pattern the share of an exposure in which the lamp is lit.

        Args:
            time_s: mid-exposure. [s]
            exposure_s: exposure time. [s]
        """
        return tuple(self._lit_fraction(pattern, time_s, exposure_s) for pattern in self.patterns)

    def _lit_fraction(self, pattern: str, time_s: float, exposure_s: float) -> float:
        # In slots from the beginning of a round, so that large time stamps lose no digits.
        begin = ((time_s + (self.slot_s - exposure_s) / 2) % (len(pattern) * self.slot_s)) / self.slot_s
        end = begin + exposure_s / self.slot_s
        first, last = math.floor(begin), math.floor(end)
        if first == last or exposure_s == 0:
            return float(pattern[first % len(pattern)])
        rounds, rest = divmod(last - first - 1, len(pattern))
        lit = rounds * pattern.count("1") + sum(int(pattern[(first + 1 + i) % len(pattern)]) for i in range(rest))
        lit_slots = lit + int(pattern[first % len(pattern)]) * (first + 1 - begin)
        lit_slots += int(pattern[last % len(pattern)]) * (end - last)
        # Rounded, so that a lamp that is lit all the time is lit fully.
        return min(1.0, round(lit_slots / (end - begin), 9))


# Markers on a body without a face lie in round dark holders of this width around them and this thickness (our choice).
HOLDER_BORDER_M = 0.006
HOLDER_THICKNESS_M = 0.005
# Struts, leaves and walls reach no further inwards of their line, and nothing stands closer to a holder or a lamp.
_WALL_ROOM_M, _CLEARANCE_M = 0.006, 0.001
_FEWEST_RIBS = 6
# Our choices for a body's coupling: heads of the bolts on its flange; mouth of its guide over the flange; its narrowest
# part around the bore, from the hose's radius (0) to the flange's (1); end of the bore along it.
BOLT_RADIUS_M = 0.004
_ENTRY_FRACTION = 0.8
BODY_FRACTION, BORE_LENGTH_FRACTION = 0.75, 0.6


class DrogueParameters(FrozenModel):
    """A drogue, with round markers or without.

    Attributes:
        name: for tables and messages.
        rim_radius_m: outermost radius. [m]
        face_inner_radius_m: radius of the opening of the flat face, which lies between it and the rim; a drogue with a
            `body` has no face. [m]
        rim_tube_radius_m: radius of the torus around the rim, flush with the rim plane in front. [m]
        marker_positions_m: x and y of the markers' centres; may be empty. [m]
        marker_depths_m: their distances behind the rim plane, or nothing where all lie in it. They face the mouth. [m]
        marker_radius_m: [m]
        marker_reflectance_rgb: diffuse reflectance in linear Rec. 709.
        marker_luminance_cd_m2: luminance of self-lit markers, 0 for painted ones. [cd/m2]
        marker_emission_rgb: colour of self-lit markers; scaled so that its luminance is 1.
        marker_code: how self-lit markers blink, or None where they shine all the time.
        face_reflectance_rgb: of face and rim.
        canopy_reflectance_rgb: of the drag canopy: cloth, leaves or cone.
        structure_reflectance_rgb: of ribs, coupling and hose.
        hub: the hub feature, or none.
        rib_count: struts between rim and coupling; leaves or straps of a body that has these (a cone has none).
        coupling_radius_m: of the body behind the hub face. [m]
        coupling_length_m: of the body behind the hub face. [m]
        hose_radius_m: [m]
        body_mesh: a mesh instead of canopy, ribs and coupling, or none; its pixels count as coupling.
        satin: paint with a sheen on some parts, or none.
        body: a basket, leaves, ribbons or a cone instead of the flat face with ribs behind it, or none.
    """

    name: str = Field(min_length=1, max_length=80)
    rim_radius_m: Metres = 0.33  # seed paper, section 4.3: drogue diameter 0.66 m
    face_inner_radius_m: Metres = 0.21  # leaves 10 mm of face inside every marker
    rim_tube_radius_m: Metres = 0.006
    marker_positions_m: tuple[PlanePoint, ...] = Field(max_length=32)
    marker_depths_m: tuple[Depth, ...] = Field(default=(), max_length=32, exclude_if=lambda depths: not depths)
    marker_radius_m: Metres = (
        0.05  # seed paper, section 4.3, read as a diameter of 10 cm (docs/reference/conventions.md)
    )
    marker_reflectance_rgb: ReflectanceRgb = RED_PAINT
    marker_luminance_cd_m2: float = Field(default=0.0, ge=0, le=1e6)
    marker_emission_rgb: ReflectanceRgb = (1.0, 0.05, 0.05)
    marker_code: MarkerCode | None = Field(default=None, exclude_if=lambda code: code is None)
    face_reflectance_rgb: ReflectanceRgb = MATT_BLACK
    canopy_reflectance_rgb: ReflectanceRgb = (0.16, 0.17, 0.15)
    structure_reflectance_rgb: ReflectanceRgb = (0.08, 0.08, 0.085)
    hub: HubParameters | None = HubParameters()
    rib_count: int = Field(default=24, ge=0, le=96)
    coupling_radius_m: Metres = 0.085
    coupling_length_m: Metres = 0.20
    hose_radius_m: Metres = 0.0335  # hose diameter 67 mm
    body_mesh: BodyMesh | None = None
    satin: SatinPaint | None = Field(default=None, exclude_if=lambda satin: satin is None)
    body: DrogueBody | None = Field(default=None, exclude_if=lambda body: body is None)

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.body is None:
            self._check_face()
        else:
            self._check_body(self.body)
        border_m = 0.0 if self.body is None else HOLDER_BORDER_M
        for index, (x, y) in enumerate(self.marker_positions_m):
            for other, (x2, y2) in enumerate(self.marker_positions_m[:index]):
                if math.hypot(x - x2, y - y2) <= 2 * (self.marker_radius_m + border_m):
                    raise ValueError(f"marker_positions_m: markers {other} and {index} overlap")
        if self.marker_luminance_cd_m2 > 0 and max(self.marker_emission_rgb) == 0:
            raise ValueError("marker_emission_rgb: markers that are lit need a colour above 0")
        self._check_code()
        if self.body_mesh is not None and self.satin is not None and set(self.satin.parts) != {"coupling"}:
            raise ValueError('satin.parts: must be ["coupling"] beside body_mesh, which counts as that')
        if self.hub is not None and self.hub.outer_radius_m >= self.coupling_radius_m:
            raise ValueError(f"coupling_radius_m: must exceed the hub's outer radius, {self.hub.outer_radius_m} m")
        if self.hose_radius_m >= self.coupling_radius_m:
            raise ValueError(f"hose_radius_m: must be below coupling_radius_m ({self.coupling_radius_m} m)")
        return self

    def _check_code(self) -> None:
        if self.marker_code is None:
            return
        if self.marker_luminance_cd_m2 == 0:
            raise ValueError("marker_code: only lamps blink; set marker_luminance_cd_m2 above 0")
        count = len(self.marker_code.patterns)
        if count not in (1, self.marker_count):
            raise ValueError(f"marker_code.patterns: must be {self.marker_count}, or one for all, got {count}")

    def lit_fractions(self, time_s: float, exposure_s: float) -> tuple[float, ...]:
        """For each marker the share of an exposure in which its lamp is lit; 1 for lamps that do not blink.

        Args:
            time_s: mid-exposure. [s]
            exposure_s: exposure time. [s]
        """
        if self.marker_code is None:
            return (1.0,) * self.marker_count
        lit = self.marker_code.lit_fractions(time_s, exposure_s)
        return lit if len(lit) == self.marker_count else lit * self.marker_count

    def _check_face(self) -> None:
        face_outer_m = self.rim_radius_m - self.rim_tube_radius_m
        if self.face_inner_radius_m >= face_outer_m:
            raise ValueError(f"face_inner_radius_m: must be below {face_outer_m:g} m, where the rim begins")
        if self.coupling_radius_m >= self.face_inner_radius_m:
            raise ValueError(f"coupling_radius_m: must be below face_inner_radius_m ({self.face_inner_radius_m} m)")
        if self.hub_depth_m <= 2 * self.rim_tube_radius_m:
            raise ValueError(f"hub.depth_m: must exceed the rim's thickness, {2 * self.rim_tube_radius_m:g} m")
        if self.marker_depths_m:
            raise ValueError("marker_depths_m: markers lie in the flat face; leave it out, or give the drogue a body")
        for index, (x, y) in enumerate(self.marker_positions_m):
            distance = math.hypot(x, y)
            if (
                distance + self.marker_radius_m >= face_outer_m
                or distance - self.marker_radius_m <= self.face_inner_radius_m
            ):
                raise ValueError(
                    f"marker_positions_m: marker {index} must lie on the face between {self.face_inner_radius_m:g} and "
                    f"{face_outer_m:g} m, but reaches from {distance - self.marker_radius_m:g} to "
                    f"{distance + self.marker_radius_m:g} m"
                )

    def _check_body(self, body: DrogueBody) -> None:
        if self.body_mesh is not None:
            raise ValueError("body: leave it out, or leave out body_mesh, which takes its place")
        if self.hub is not None and self.hub.depth_m != body.depth_m:
            raise ValueError(f"hub.depth_m: must be body.depth_m ({body.depth_m} m), or give hub = false for none")
        widest_m = self.opening_radius_m - 2 * _WALL_ROOM_M
        if self.coupling_radius_m >= widest_m:
            raise ValueError(f"coupling_radius_m: must be below {widest_m:g} m, as the body narrows towards it")
        if body.depth_m <= 4 * self.rim_tube_radius_m + HOLDER_THICKNESS_M:
            raise ValueError(f"body.depth_m: must exceed {4 * self.rim_tube_radius_m + HOLDER_THICKNESS_M:g} m")
        if self.rib_count < (0 if body.family == "cone" else _FEWEST_RIBS):
            raise ValueError(f"rib_count: a body of {body.family} needs at least {_FEWEST_RIBS}")
        if self.marker_depths_m and len(self.marker_depths_m) != self.marker_count:
            raise ValueError(f"marker_depths_m: must be one for each of the {self.marker_count} markers, or none")
        _check_coupling(self, body)
        if body.lamps is not None:
            ring_m, lamp_m = self._lamp_ring_m(body.lamps.radius_m), body.lamps.radius_m
            if (body.lamps.count > 1 and ring_m * math.sin(math.pi / body.lamps.count) <= lamp_m) or ring_m <= 0:
                raise ValueError("body.lamps: do not fit side by side inside the rim; lower count or radius_m")
        for index, (x, y, depth) in enumerate(self.marker_centers_m):
            distance, reach = math.hypot(x, y), self.marker_radius_m + HOLDER_BORDER_M
            back_m = depth + HOLDER_THICKNESS_M
            if back_m >= body.depth_m:
                raise ValueError(f"marker_depths_m: marker {index} must lie before the coupling at {body.depth_m:g} m")
            room_m = self.inner_radius_m(back_m) - _CLEARANCE_M
            if distance + reach > room_m:
                raise ValueError(
                    f"marker_positions_m: marker {index} with its holder must lie within {room_m:.4f} m of the axis at "
                    f"its depth of {depth:g} m, but reaches to {distance + reach:.4f} m"
                )
            for x2, y2 in self.lamp_positions_m:
                assert body.lamps is not None
                if math.hypot(x - x2, y - y2) < reach + body.lamps.radius_m:
                    raise ValueError(
                        f"marker_positions_m: marker {index} overlaps a lamp; move it, or change body.lamps"
                    )

    @property
    def marker_count(self) -> int:
        """Number of markers."""
        return len(self.marker_positions_m)

    @property
    def marker_centers_m(self) -> tuple[tuple[float, float, float], ...]:
        """Centres of the markers in the drogue frame. [m]"""
        depths = self.marker_depths_m or (0.0,) * self.marker_count
        return tuple((x, y, depth) for (x, y), depth in zip(self.marker_positions_m, depths, strict=True))

    @property
    def hub_depth_m(self) -> float:
        """Depth of the coupling's front face behind the rim plane. [m]"""
        if self.body is not None:
            return self.body.depth_m
        return self.hub.depth_m if self.hub is not None else HubParameters().depth_m

    @property
    def opening_radius_m(self) -> float:
        """Radius of the mouth: of the flat face's opening, or of the inner edge of a body's rim. [m]"""
        return self.face_inner_radius_m if self.body is None else self.rim_radius_m - 2 * self.rim_tube_radius_m

    @property
    def body_line(self) -> BodyLine:
        """The line of the struts, leaves or walls, from inside the rim to the coupling's collar.

        Raises:
            ValueError: the drogue has no `body`.
        """
        if self.body is None:
            raise ValueError("body: the drogue has a flat face")
        tube_m = self.rim_tube_radius_m
        back = (self.coupling_radius_m, self.hub_depth_m + 0.15 * self.coupling_length_m)
        return BodyLine((self.rim_radius_m - tube_m, tube_m), back, self.body.flare)

    @property
    def bulges_m(self) -> tuple[tuple[float, float], ...]:
        """Circles (radius, z) around a body between rim and coupling, none of which lies beyond the rim. [m]"""
        if self.body is None:
            return ()
        line = self.body_line
        depths = [line.front_m[1] + (line.back_m[1] - line.front_m[1]) * step / 8 for step in range(8)]
        reach_m = self.body.reach_m
        return tuple((min(line.radius_m(depth) + reach_m, self.rim_radius_m), depth + reach_m) for depth in depths)

    def inner_radius_m(self, z_m: float) -> float:
        """Radius that a body leaves free at a depth. [m]

        Raises:
            ValueError: the drogue has no `body`.
        """
        return self.body_line.radius_m(z_m) - self.rim_tube_radius_m - _WALL_ROOM_M

    @property
    def coupling_entry_radius_m(self) -> float:
        """Radius of the guide's mouth in a body's coupling. [m]"""
        return _ENTRY_FRACTION * self.coupling_radius_m if self.hub is None else self.hub.inner_radius_m

    @property
    def lamp_positions_m(self) -> tuple[PlanePoint, ...]:
        """Centres of the lamps inside the rim, x and y. [m]"""
        lamps = None if self.body is None else self.body.lamps
        if lamps is None:
            return ()
        return even_ring(lamps.count, self._lamp_ring_m(lamps.radius_m))

    def _lamp_ring_m(self, lamp_radius_m: float) -> float:
        return self.inner_radius_m(2 * lamp_radius_m) - lamp_radius_m - _CLEARANCE_M


def _check_coupling(drogue: DrogueParameters, body: DrogueBody) -> None:
    coupling, hub, collar_m = body.coupling, drogue.hub, drogue.coupling_radius_m
    entry_m, hose_m = drogue.coupling_entry_radius_m, drogue.hose_radius_m
    widest_m = min(entry_m, hose_m + BODY_FRACTION * (collar_m - hose_m)) - _CLEARANCE_M
    if coupling.throat_radius_m >= widest_m:
        raise ValueError(f"body.coupling.throat_radius_m: must be below {widest_m:g} m to fit the coupling")
    longest_m = 0.9 * BORE_LENGTH_FRACTION * drogue.coupling_length_m
    if coupling.guide_length_m >= longest_m:
        raise ValueError(f"body.coupling.guide_length_m: must be below {longest_m:g} m to fit the coupling")
    flange_m = collar_m - (entry_m if hub is None else hub.outer_radius_m)
    if coupling.bolt_count and flange_m < 3 * BOLT_RADIUS_M:
        raise ValueError(
            f"body.coupling.bolt_count: bolts need a flange of {3 * BOLT_RADIUS_M:g} m, there is {flange_m:.4f} m"
        )


def even_ring(count: int, radius_m: float) -> tuple[PlanePoint, ...]:
    """Centres of `count` evenly spaced markers on a circle, the first on the +y axis. [m]"""
    angles = [math.pi / 2 + 2 * math.pi * index / count for index in range(count)]
    return tuple((radius_m * math.cos(angle), radius_m * math.sin(angle)) for angle in angles)
