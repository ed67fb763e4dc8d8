"""Sky, sun, moon, clouds, mist, air and ground of one scene."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal, Self, get_args

from pydantic import Field, model_validator

from drogue_models.frozen_model import FrozenModel, ReflectanceRgb
from drogue_models.untrusted_files import read_regular

CloudKind = Literal["cumulus", "congestus", "stratus", "altocumulus", "cirrus", "contrail", "rain"]

GroundKind = Literal["sea", "forest", "fields", "dry", "coast", "town", "mountains", "snow", "airfield"]

GROUND_KINDS: tuple[GroundKind, ...] = get_args(GroundKind)

SkyModel = Literal["daylight", "scattering"]

Turbulence = Literal["none", "light", "moderate", "severe"]

MIN_AIRSPEED_M_S = 5.0
"""Lowest airspeed with turbulence: the frozen gust field moves past the aircraft at its airspeed. [m/s]"""

LEAST_THICKNESS_M = 10.0
"""Thickness of the thinnest layer of cloud. [m]"""

MAP_SUFFIXES = (".exr", ".hdr")

# Six contrails some 500 m wide over a few tens of kilometres.
_CONTRAIL_SHARE = 0.1


class CloudLayer(FrozenModel):
    """A layer of cloud above or below the camera.

    Attributes:
        kind: `cumulus` heaps with a flat base, `congestus` towers, `stratus` a mottled sheet, `altocumulus` small cells
            in one sheet, `cirrus` streaks of ice, `contrail` trails of aircraft, `rain` shafts that hang down to
            `height_above_camera_m` or evaporate before.
        height_above_camera_m: of the side that faces the camera: the base above it, or, negative, the top below. [m]
        thickness_m: from base to the highest tops; cirrus and contrails ignore it. [m]
        cover_fraction: share of the layer's plan that is cloud, of cirrus with more than a tenth of `optical_depth`; of
            contrails it sets the number, one to six.
        feature_size_m: size of the largest clouds. [m]
        optical_depth: in the thick parts, vertically.
        heading_deg: direction of streaks and trails, and against which rain leans, from east towards north. [deg]
        texture_seed: seed of its pattern.
    """

    kind: CloudKind = "cumulus"
    height_above_camera_m: float = Field(ge=-15000, le=15000)
    thickness_m: float = Field(default=600.0, ge=LEAST_THICKNESS_M, le=5000)
    cover_fraction: float = Field(ge=0, le=1)
    feature_size_m: float = Field(gt=0, le=1e5)
    optical_depth: float = Field(gt=0, le=200)
    heading_deg: float = Field(default=0.0, ge=-360, le=360)
    texture_seed: int = Field(ge=0)

    @model_validator(mode="after")
    def _not_inside(self) -> Self:
        if abs(self.height_above_camera_m) < 100:
            raise ValueError("height_above_camera_m: the camera must stay 100 m clear of a layer; inside, use mist")
        if self.kind == "rain" and self.height_above_camera_m < 0:
            raise ValueError("height_above_camera_m: rain must end above the camera")
        return self

    @property
    def is_above(self) -> bool:
        """Whether it lies above the camera."""
        return self.height_above_camera_m > 0

    @property
    def shading_fraction(self) -> float:
        """Share of the layer's plan that takes light: of contrails a small part of what `cover_fraction` says."""
        return self.cover_fraction * (_CONTRAIL_SHARE if self.kind == "contrail" else 1.0)


class Mist(FrozenModel):
    """Thin cloud around the camera, between two levels.

    Attributes:
        visibility_m: meteorological range in it (2 % contrast), of patchy mist around the camera. [m]
        above_m, below_m: extent above and below the camera; the ground ends it. [m]
        patchiness: 0 for the same density everywhere, 1 for patches and layers between which it is nearly clear.
        texture_seed: seed of the patches.
    """

    visibility_m: float = Field(ge=10, le=100_000)
    above_m: float = Field(gt=0, le=10_000)
    below_m: float = Field(gt=0, le=10_000)
    # Left out at their defaults, so that the hashes of scenes with even mist stay those of earlier versions.
    patchiness: float = Field(default=0.0, ge=0, le=1, exclude_if=lambda share: share == 0.0)
    texture_seed: int = Field(default=0, ge=0, exclude_if=lambda seed: seed == 0)

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
    """An image file, pinned by its hash, and its absolute light level, of which exactly one form is given.

    Attributes:
        path: of an equirectangular image, `.exr` or Radiance `.hdr`, as the user wrote it; relative to the
            recipe's folder unless absolute.
        sha256: of the file.
        folder: the recipe's folder. It is not stored with a dataset, whose contents must not depend on the place where
            it was made; a frame that is read back looks in the working directory.
        cd_m2_per_unit: luminance of pixel value 1; this or the next is to be given. [cd/m2]
        horizontal_illuminance_lux: illuminance of level ground by the image's upper half, sun included. [lux]
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
        """Path of the image."""
        return self.folder / self.path


class EnvironmentMap(EnvironmentMapFile):
    """A user's image of sky and ground all around, which replaces the modelled ones in one scene.

    Attributes:
        rotation_deg: azimuth of the image's centre, from east towards north; the image is not mirrored: what is right
            of the centre in the image is right of it in the world. [deg]
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
        camera_offset_m: east and north, from the origin of ground and cloud patterns; only sequences move away from
            it. [m]
        ground: kind of ground; `town` is surrounded by fields.
        ground_reflectance_rgb: mean diffuse reflectance of the ground, of a coast's land, or of the water under the
            surface of the sea.
        ground_texture_seed: seed of its pattern, shoreline and ships.
        wind_speed_m_s: over the sea; sets waves, glint and foam. [m/s]
        clouds: cloud layers, in any order.
        mist: thin cloud around the camera, or none.
        moon: or none.
        map: an image of sky and ground that replaces all of the above but the visibility, or none.
        sky_model: `daylight` is Preetham's sky, with twilight after measurements, over air of one density and level
            ground; `scattering` follows light through a round atmosphere that thins out with height, and there
            `visibility_m` is that of the air at the ground.
    """

    sun_elevation_deg: float = Field(ge=-90, le=90)
    sun_azimuth_deg: float = Field(ge=-360, le=360)
    turbidity: float = Field(ge=1.9, le=10)
    visibility_m: float = Field(ge=500, le=400_000)
    altitude_m: float = Field(ge=10, le=20_000)
    # Left out at its default, so that the hashes of single pairs stay those of earlier versions.
    camera_offset_m: tuple[float, float] = Field(default=(0.0, 0.0), exclude_if=lambda offset_m: offset_m == (0.0, 0.0))
    ground: GroundKind = "fields"
    ground_reflectance_rgb: ReflectanceRgb
    ground_texture_seed: int = Field(ge=0)
    wind_speed_m_s: float = Field(default=7.0, ge=0, le=40)
    clouds: tuple[CloudLayer, ...] = Field(default=(), max_length=6)
    mist: Mist | None = None
    moon: Moon | None = None
    map: EnvironmentMap | None = None
    # Left out at its default, as above.
    sky_model: SkyModel = Field(default="daylight", exclude_if=lambda model: model == "daylight")

    @property
    def extinction_per_m(self) -> float:
        """Extinction coefficient that the visibility stands for, without mist (Koschmieder, contrast 2 %). [1/m]"""
        return 3.912 / self.visibility_m


def pin_environment_map(table: dict[str, Any], folder: Path) -> None:
    """Replace the map's file name in an `[environment]` table, if it has one, by path, hash and folder, in place.

    Raises:
        ValueError: not a file name, or a file that cannot be read.
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
    """Contents of an environment map's file.

    Raises:
        ValueError: it is missing, or its hash is not that of the file when the recipe was read.
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
        return read_regular(file)
    except OSError as error:
        raise ValueError(
            f"environment.map: {file} cannot be read: {error.strerror}; a frame from a dataset looks for its map in "
            "the working directory"
        ) from error
