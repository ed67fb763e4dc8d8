"""What hangs in the air and in the sky of one scene: cloud layers, mist around the camera, the moon."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel

CloudKind = Literal["cumulus", "stratus", "cirrus"]


class CloudLayer(FrozenModel):
    """A layer of cloud above or below the camera.

    Attributes:
        kind: `cumulus` heaps with a flat base, `stratus` a mottled sheet, `cirrus` thin streaks of ice.
        height_above_camera_m: of the side that faces the camera: the base above it, or, negative, the top below. [m]
        thickness_m: from base to the highest tops; nothing for cirrus, which has none. [m]
        cover_fraction: share of the layer's plan that is cloud.
        feature_size_m: size of the largest clouds. [m]
        optical_depth: in the thick parts, vertically.
        heading_deg: along which cirrus is drawn out; from east towards north. [deg]
        texture_seed: of its pattern.
    """

    kind: CloudKind = "cumulus"
    height_above_camera_m: float = Field(ge=-15000, le=15000)
    thickness_m: float = Field(default=600.0, ge=10, le=5000)
    cover_fraction: float = Field(ge=0, le=1)
    feature_size_m: float = Field(gt=0, le=1e5)
    optical_depth: float = Field(gt=0, le=200)
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    texture_seed: int = Field(ge=0)

    @model_validator(mode="after")
    def _not_inside(self) -> Self:
        if abs(self.height_above_camera_m) < 100:
            raise ValueError("height_above_camera_m: the camera must stay 100 m clear of a layer; inside, use mist")
        return self

    @property
    def is_above(self) -> bool:
        """Whether the camera flies under it."""
        return self.height_above_camera_m > 0


class Mist(FrozenModel):
    """Thin cloud that the camera flies in: even droplets between two levels.

    Attributes:
        visibility_m: meteorological range in it (2 % contrast). [m]
        above_m, below_m: how far it reaches above and below the camera. [m]
    """

    visibility_m: float = Field(ge=10, le=100_000)
    above_m: float = Field(gt=0, le=10_000)
    below_m: float = Field(gt=0, le=10_000)

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of the droplets (Koschmieder, contrast 2 %). [1/m]"""
        return 3.912 / self.visibility_m


class Moon(FrozenModel):
    """The moon of one scene.

    Attributes:
        elevation_deg, azimuth_deg: direction to it; azimuth from east towards north. [deg]
        phase_angle_deg: 0 full, 90 half, 180 new. Its lit side faces the sun of the scene. [deg]
    """

    elevation_deg: float = Field(ge=-90, le=90)
    azimuth_deg: float = Field(ge=-360, le=360)
    phase_angle_deg: float = Field(default=0.0, ge=0, le=180)
