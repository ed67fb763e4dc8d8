"""Dimensions and surface properties of a drogue, from a preset or a user's TOML file.

Drogue frame: origin at the centre of the marker circle in the rim plane, z along the axis from the mouth to the hose.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel, Metres, ReflectanceRgb

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
            place where it was made; a drogue that is read back looks in the working directory.
    """

    path: str = Field(min_length=1, max_length=1000)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    folder: Path = Field(default=Path(), exclude=True)

    @property
    def file(self) -> Path:
        """Path of the mesh."""
        return self.folder / self.path


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


class DrogueParameters(FrozenModel):
    """A drogue with round markers set into its dark face.

    Attributes:
        name: for tables and messages.
        rim_radius_m: outermost radius. [m]
        face_inner_radius_m: radius of the opening; the face lies between it and the rim. [m]
        rim_tube_radius_m: radius of the matt black torus around the rim, flush with the face in front. [m]
        marker_positions_m: centres of the markers in the rim plane. [m]
        marker_radius_m: [m]
        marker_reflectance_rgb: diffuse reflectance in linear Rec. 709.
        marker_luminance_cd_m2: luminance of self-lit markers, 0 for painted ones. [cd/m2]
        marker_emission_rgb: colour of self-lit markers; scaled so that its luminance is 1.
        face_reflectance_rgb, canopy_reflectance_rgb, structure_reflectance_rgb: of face and rim, of the drag canopy, of
            ribs, coupling and hose.
        hub: the hub feature, or none.
        rib_count: struts between rim and coupling.
        coupling_radius_m, coupling_length_m: the body behind the hub face. [m]
        hose_radius_m: [m]
        body_mesh: a mesh instead of canopy, ribs and coupling, or none; its pixels count as coupling.
        satin: paint with a sheen on some parts, or none.
    """

    name: str = Field(min_length=1, max_length=80)
    rim_radius_m: Metres = 0.33  # seed paper, section 4.3: drogue diameter 0.66 m
    face_inner_radius_m: Metres = 0.21  # leaves 10 mm of face inside every marker
    rim_tube_radius_m: Metres = 0.006
    marker_positions_m: tuple[PlanePoint, ...] = Field(min_length=3, max_length=32)
    marker_radius_m: Metres = (
        0.05  # seed paper, section 4.3, read as a diameter of 10 cm (docs/reference/conventions.md)
    )
    marker_reflectance_rgb: ReflectanceRgb = RED_PAINT
    marker_luminance_cd_m2: float = Field(default=0.0, ge=0, le=1e6)
    marker_emission_rgb: ReflectanceRgb = (1.0, 0.05, 0.05)
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

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        face_outer_m = self.rim_radius_m - self.rim_tube_radius_m
        if self.face_inner_radius_m >= face_outer_m:
            raise ValueError(f"face_inner_radius_m: must be below {face_outer_m:g} m, where the rim begins")
        if self.coupling_radius_m >= self.face_inner_radius_m:
            raise ValueError(f"coupling_radius_m: must be below face_inner_radius_m ({self.face_inner_radius_m} m)")
        if self.hub_depth_m <= 2 * self.rim_tube_radius_m:
            raise ValueError(f"hub.depth_m: must exceed the rim's thickness, {2 * self.rim_tube_radius_m:g} m")
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
            for other, (x2, y2) in enumerate(self.marker_positions_m[:index]):
                if math.hypot(x - x2, y - y2) <= 2 * self.marker_radius_m:
                    raise ValueError(f"marker_positions_m: markers {other} and {index} overlap")
        if self.hub is not None and self.hub.outer_radius_m >= self.coupling_radius_m:
            raise ValueError(f"coupling_radius_m: must exceed the hub's outer radius, {self.hub.outer_radius_m} m")
        if self.hose_radius_m >= self.coupling_radius_m:
            raise ValueError(f"hose_radius_m: must be below coupling_radius_m ({self.coupling_radius_m} m)")
        return self

    @property
    def marker_count(self) -> int:
        """Number of markers."""
        return len(self.marker_positions_m)

    @property
    def hub_depth_m(self) -> float:
        """Depth of the coupling's front face behind the rim plane. [m]"""
        return self.hub.depth_m if self.hub is not None else HubParameters().depth_m


def even_ring(count: int, radius_m: float) -> tuple[PlanePoint, ...]:
    """Centres of `count` evenly spaced markers on a circle, the first on the +y axis. [m]"""
    angles = [math.pi / 2 + 2 * math.pi * index / count for index in range(count)]
    return tuple((radius_m * math.cos(angle), radius_m * math.sin(angle)) for angle in angles)
