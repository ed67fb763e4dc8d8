"""A sheet with one picture of each kind of cloud, and of patchy mist."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.atomic import write_bytes_atomic
from datasets_manifest.types.environment import CloudLayer, Environment, Mist
from datasets_manifest.types.images import srgb_from_light
from scenes.environment_radiance import EnvironmentRadiance
from scenes.sky.photometry import luminance
from studies.realism.cloud_measures import pitched_rays

Picture = NDArray[np.uint8]

_COLUMNS = 4
_SUFFIXES = (".jpg", ".jpeg", ".png")
_TILE_PX = 400
# Rays are sent for half pixels, so that thin trails have no steps.
_RAYS_PER_SIDE = 2
# A view of 53 degrees across.
_FOCAL_PER_WIDTH = 1.0
_HEIGHT_PER_WIDTH = 0.75
_BRIGHTEST_PERCENT, _WHITE = 99.5, 0.9


def _layer(kind: str, height_above_camera_m: float, feature_size_m: float, **shape: float) -> CloudLayer:
    values = {"kind": kind, "height_above_camera_m": height_above_camera_m, "feature_size_m": feature_size_m}
    return CloudLayer.model_validate(values | shape | {"texture_seed": 1})


# What is drawn: how far up the camera looks [deg], and the layers.
_VIEWS: dict[str, tuple[float, tuple[CloudLayer, ...]]] = {
    "cumulus": (
        9.0,
        (_layer("cumulus", 900.0, 1500.0, cover_fraction=0.35, thickness_m=800.0, optical_depth=25.0),),
    ),
    "congestus": (
        9.0,
        (_layer("congestus", 400.0, 1400.0, cover_fraction=0.25, thickness_m=2200.0, optical_depth=30.0),),
    ),
    "altocumulus": (
        14.0,
        (_layer("altocumulus", 1500.0, 450.0, cover_fraction=0.5, thickness_m=150.0, optical_depth=4.0),),
    ),
    "cirrus": (20.0, (_layer("cirrus", 6000.0, 4000.0, cover_fraction=0.6, optical_depth=0.9),)),
    "contrail": (20.0, (_layer("contrail", 4000.0, 600.0, cover_fraction=0.4, optical_depth=0.8),)),
    "rain": (
        5.0,
        (
            _layer("stratus", 1400.0, 1500.0, cover_fraction=1.0, thickness_m=400.0, optical_depth=12.0),
            _layer("rain", 200.0, 2500.0, cover_fraction=0.4, thickness_m=1200.0, optical_depth=2.5),
        ),
    ),
    "stratus": (
        -9.0,
        (_layer("stratus", -900.0, 2000.0, cover_fraction=0.97, thickness_m=600.0, optical_depth=18.0),),
    ),
    "patchy mist": (-3.0, ()),
}
KINDS = tuple(_VIEWS)
"""Names of the pictures: the kinds of cloud, and patchy mist."""
_MIST = Mist(visibility_m=1500.0, above_m=80.0, below_m=300.0, patchiness=0.9, texture_seed=1)


def cloud_picture(name: str, width_px: int) -> Picture:
    """(3 W / 4, W, 3) a kind of cloud as a camera shows it whose brightest parts are just below white: sRGB, 0 to 255.

    Raises:
        KeyError: no such kind.
    """
    up_deg, layers = _VIEWS[name]
    environment = Environment(
        sun_elevation_deg=38.0,
        sun_azimuth_deg=110.0,
        turbidity=2.5,
        visibility_m=80_000.0,
        altitude_m=3000.0,
        ground_reflectance_rgb=(0.1, 0.1, 0.06),
        ground="sea",
        ground_texture_seed=1,
        clouds=layers,
        mist=None if layers else _MIST,
        sky_model="scattering",
    )
    height_px = round(width_px * _HEIGHT_PER_WIDTH)
    columns, rows = width_px * _RAYS_PER_SIDE, height_px * _RAYS_PER_SIDE
    u, v = np.meshgrid(np.arange(columns) + 0.5 - columns / 2, np.arange(rows) + 0.5 - rows / 2)
    light = EnvironmentRadiance(environment).radiance(pitched_rays(u, v, _FOCAL_PER_WIDTH * columns, up_deg))
    light = cv2.resize(light, (width_px, height_px), interpolation=cv2.INTER_AREA)
    exposed = light * (_WHITE / np.percentile(luminance(light), _BRIGHTEST_PERCENT))
    picture: Picture = np.rint(255.0 * srgb_from_light(np.clip(exposed, 0.0, 1.0))).astype(np.uint8)
    return picture


def cloud_sheet(tile_px: int = _TILE_PX) -> Picture:
    """(3 W / 2, 4 W, 3) all kinds, each in a tile W = `tile_px` wide with its name: sRGB, 0 to 255."""
    tiles = [_named(cloud_picture(name, tile_px), name) for name in _VIEWS]
    rows = [np.hstack(tiles[start : start + _COLUMNS]) for start in range(0, len(tiles), _COLUMNS)]
    sheet: Picture = np.vstack(rows)
    return sheet


def write_cloud_sheet(path: Path, tile_px: int = _TILE_PX) -> None:
    """Write the sheet as a PNG or JPEG file.

    Raises:
        ValueError: another ending of the name.
        OSError: it cannot be written.
    """
    if path.suffix.lower() not in _SUFFIXES:
        raise ValueError(f"--out: {path} must end with {', '.join(_SUFFIXES)}")
    _, data = cv2.imencode(path.suffix, cv2.cvtColor(cloud_sheet(tile_px), cv2.COLOR_RGB2BGR))
    write_bytes_atomic(path, data.tobytes())


def _named(picture: Picture, name: str) -> Picture:
    """The picture with its name in white with a dark outline."""
    named = picture.copy()
    for grey, thickness in ((0, 4), (255, 1)):
        place, font = (8, len(named) - 10), cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(named, name, place, font, 0.5, (grey, grey, grey), thickness, cv2.LINE_AA)
    return named
