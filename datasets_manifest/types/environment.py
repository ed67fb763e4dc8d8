"""Sky, sun, moon, clouds, mist, air and ground of one scene."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal, Self, get_args

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel
from drogue_models.parameters import ReflectanceRgb

CloudKind = Literal["cumulus", "stratus", "cirrus"]

GroundKind = Literal["sea", "forest", "fields", "dry", "coast", "town"]

GROUND_KINDS: tuple[GroundKind, ...] = get_args(GroundKind)

Turbulence = Literal["none", "light", "moderate", "severe"]

SLOWEST_M_S = 5.0
"""Airspeed from which on there can be turbulence: a frozen field needs to be flown through. [m/s]"""

MAP_SUFFIXES = (".exr", ".hdr")


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


class EnvironmentMapFile(FrozenModel):
    """A file that is pinned by its contents, and the level of its light; one of the two levels must be given.

    Attributes:
        path: of an equirectangular picture, `.exr` or Radiance `.hdr`, as the user wrote it; relative to `folder`
            unless absolute.
        sha256: of the file.
        folder: where the recipe lies. It is not stored with a dataset, which must not depend on where it was made; a
            frame that is read back looks in the working directory.
        cd_m2_per_unit: luminance of the picture's value 1. [cd/m2]
        horizontal_illuminance_lux: what the picture's upper half gives level ground, sun included. [lux]
    """

    path: str = Field(min_length=1, max_length=1000)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    folder: Path = Field(default=Path(), exclude=True)
    cd_m2_per_unit: float | None = Field(default=None, gt=0, le=1e9)
    horizontal_illuminance_lux: float | None = Field(default=None, gt=0, le=1e6)

    @model_validator(mode="after")
    def _one_level(self) -> Self:
        if (self.cd_m2_per_unit is None) == (self.horizontal_illuminance_lux is None):
            raise ValueError("cd_m2_per_unit, horizontal_illuminance_lux: give one of the two")
        return self

    @property
    def file(self) -> Path:
        """Where the picture lies."""
        return self.folder / self.path


class EnvironmentMap(EnvironmentMapFile):
    """The map of one scene.

    Attributes:
        rotation_deg: azimuth, from east towards north, of the middle of the picture; what stands right of it in the
            picture stands right of it in the world. [deg]
    """

    rotation_deg: float = Field(default=0.0, ge=-360, le=360)


class Environment(FrozenModel):
    """Sky, sun, air and ground of one scene, in world axes (x east, y north, z up).

    Attributes:
        sun_elevation_deg, sun_azimuth_deg: direction to the sun; azimuth from east towards north. Below the horizon
            there is twilight, then night. [deg]
        turbidity: Linke-like turbidity of Preetham's model, 2 very clear to 6 hazy.
        visibility_m: meteorological range (2 % contrast), which sets the extinction of the air. [m]
        altitude_m: of the camera above ground. [m]
        camera_offset_m: east and north of the place about which ground and clouds are laid out; only a sequence flies
            away from it. [m]
        ground: what lies below; `town` runs out into fields.
        ground_reflectance_rgb: mean diffuse reflectance of the ground, of a coast's land, or of the water under the
            surface of the sea.
        ground_texture_seed: of its pattern, shoreline and ships.
        wind_speed_m_s: over the sea, which sets waves, glint and foam. [m/s]
        clouds: cloud layers, in any order.
        mist: thin cloud around the camera, or none.
        moon: or none.
        map: a picture of sky and ground that takes the place of all the others but the visibility, or none.
    """

    sun_elevation_deg: float = Field(ge=-90, le=90)
    sun_azimuth_deg: float = Field(ge=-360, le=360)
    turbidity: float = Field(ge=1.9, le=10)
    visibility_m: float = Field(ge=500, le=400_000)
    altitude_m: float = Field(ge=10, le=20_000)
    # Left out where it says nothing, so that the hashes of single pairs do not know of it.
    camera_offset_m: tuple[float, float] = Field(default=(0.0, 0.0), exclude_if=lambda offset_m: offset_m == (0.0, 0.0))
    ground: GroundKind = "fields"
    ground_reflectance_rgb: ReflectanceRgb
    ground_texture_seed: int = Field(ge=0)
    wind_speed_m_s: float = Field(default=7.0, ge=0, le=40)
    clouds: tuple[CloudLayer, ...] = Field(default=(), max_length=6)
    mist: Mist | None = None
    moon: Moon | None = None
    map: EnvironmentMap | None = None

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient of the clear air, without mist (Koschmieder, contrast 2 %). [1/m]"""
        return 3.912 / self.visibility_m


def pin_environment_map(table: dict[str, Any], folder: Path) -> None:
    """Replace the name of the map's file in an `[environment]` table, if it has one, by path, hash and folder.

    Raises:
        ValueError: not a name, or a file that cannot be read.
    """
    given = table.get("map")
    if isinstance(given, str):
        given = {"file": given, "cd_m2_per_unit": 1.0}
    if not isinstance(given, dict) or "file" not in given:
        if given is not None:
            raise ValueError("environment.map: must be the path of a file, or a table with the key file")
        return
    rest = {key: value for key, value in given.items() if key != "file"}
    path = given["file"]
    if not isinstance(path, str) or not path.lower().endswith(MAP_SUFFIXES):
        raise ValueError(f"environment.map: must be the path of an .exr or .hdr file, got {path!r}")
    for key in ("path", "sha256", "folder"):
        if key in rest:
            raise ValueError(f"environment.map.{key}: unknown key")
    table["map"] = {"path": path, "sha256": _sha256(folder / path), "folder": folder, **rest}


def read_environment_map(environment_map: EnvironmentMapFile) -> bytes:
    """The contents of a map's file.

    Raises:
        ValueError: it is missing, or is not the file that it was when the recipe was read.
    """
    data = _read(environment_map.file)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != environment_map.sha256:
        raise ValueError(
            f"environment.map: {environment_map.file} has changed since the recipe was read; restore the file with "
            f"sha256 {environment_map.sha256}, got {sha256}"
        )
    return data


def _sha256(file: Path) -> str:
    return hashlib.sha256(_read(file)).hexdigest()


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ValueError(
            f"environment.map: {file} cannot be read: {error.strerror}; a frame from a dataset looks for its map in "
            "the working directory"
        ) from error
