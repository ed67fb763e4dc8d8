"""Textures of land from above, 5 to 8 km wide, painted once for all scenes, with the sun's light on them and lamps.

Every texture has heights of trees and houses, from which follow their shadows; the sun stands in the direction of its
columns. Scenes differ by position, rotation and colour of the textures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest import random_streams
from datasets_manifest.random_streams import frame_generator
from datasets_manifest.user_cache import kept_arrays
from geometry import bilinear_sampling
from scenes import ground_view
from scenes.ground import land_painting
from scenes.ground.land_painting import SEED, SIZE_PX, TEXELS_M, LandKind, Rgb, bent_like, painted_land, smooth
from scenes.ground_view import Field, MipTile

SUN_TANGENTS = (0.2, 0.55, 1.3)
"""Tangents of the sun's elevation for which the share of its light is stored."""
BEAM_SCALE = 3.0
HEIGHT_SCALE_M = 40.0
"""What the value 1 of a stored share stands for."""

_SHADOW_STEPS_PX = (1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 22)
_CANOPY_SLOPE = 0.55  # trees let light through: slopes of the canopy count by this share
LAMP_CD = 260.0
"""Mean intensity of a street lamp with the street that it lights, seen from above. [cd]"""
# Sodium, warm and neutral white, and their shares.
_LAMP_RGB: tuple[tuple[float, Rgb], ...] = (
    (0.62, (1.55, 0.90, 0.28)), (0.90, (1.22, 0.97, 0.62)), (1.0, (0.93, 1.0, 1.10)),
)  # fmt: skip
_LAMP_SPREAD = 0.9  # standard deviation of the logarithm of their intensities
LAMP_PEAK_CD_M2 = 300.0
"""Radiance of the value 1 of a texture of lamps. [cd/m2]"""

_TILES = ("rgb", "beam", "cover")
# All code that the textures follow from.
_SOURCES = (
    __file__,
    *(str(module.__file__) for module in (land_painting, ground_view, bilinear_sampling, random_streams)),
)


@dataclass(frozen=True, eq=False)
class LandTextures:
    """Textures of one kind of land.

    Attributes:
        rgb: reflectance.
        beam: for each of `SUN_TANGENTS` the sun's light on every place over that on level ground, over `BEAM_SCALE`;
            1 on average, weighted with the reflectance. As the fourth channel a rank in [0, 1] that parcels share.
        cover: heights of trees, and of houses, over `HEIGHT_SCALE_M`, and the shares of trees, and of houses.
        lamps_px: (N, 2) places of street lamps before the texture was bent. [px]
    """

    rgb: MipTile
    beam: MipTile
    cover: MipTile
    lamps_px: NDArray[np.float64]


@lru_cache(maxsize=4)
def land_textures(kind: LandKind) -> LandTextures:
    """Textures of a kind of land, each of the same size and period; kept on disk, for painting takes seconds."""
    kept = kept_arrays(f"land-{kind}", _SOURCES, lambda: _painted(kind))
    rgb, beam, cover = (
        MipTile.from_arrays({key.removeprefix(f"{name} "): kept[key] for key in kept if key.startswith(f"{name} ")})
        for name in _TILES
    )
    return LandTextures(rgb, beam, cover, kept["lamps"])


def _painted(kind: LandKind) -> dict[str, NDArray[Any]]:
    """The arrays of the textures of a kind of land."""
    canvas = painted_land(kind)
    rgb = np.clip(canvas.rgb, 0.0, 1.0)
    beam = np.empty((SIZE_PX, SIZE_PX, 4), dtype=np.float32)
    beam[..., :3] = _beam_shares(canvas.height_m, canvas.texel_m, rgb.mean(axis=-1))
    beam[..., 3] = canvas.rank
    height = canvas.height_m / np.float32(HEIGHT_SCALE_M)
    cover = np.stack([height * (1.0 - canvas.built), height * canvas.built, canvas.wooded, canvas.built], axis=-1)
    tiles = (MipTile(np.clip(texels, 0.0, 1.0), canvas.texel_m, coded=True) for texels in (rgb, beam, cover))
    arrays = {
        f"{name} {key}": array
        for name, tile in zip(_TILES, tiles, strict=True)
        for key, array in tile.to_arrays().items()
    }
    return arrays | {"lamps": np.array(canvas.lamps_px, dtype=np.float64).reshape(-1, 2)}


@lru_cache(maxsize=2)
def lamp_texture(kind: LandKind) -> MipTile:
    """(3 channels) radiance of street lamps at night over `LAMP_PEAK_CD_M2`; colour and intensity differ by lamp."""
    return MipTile.from_arrays(kept_arrays(f"lamps-{kind}", _SOURCES, lambda: _lit(kind).to_arrays()))


def _lit(kind: LandKind) -> MipTile:
    land, texel_m = land_textures(kind), TEXELS_M[kind]
    rng = frame_generator(SEED, 0, f"lamps {kind}")
    light = np.zeros((SIZE_PX, SIZE_PX, 3), dtype=np.float32)
    shares = [share for share, _ in _LAMP_RGB]
    district = smooth("lamp district", 14)
    per_m2 = 1.0 / texel_m**2
    for x_px, y_px in land.lamps_px:
        x, y = int(x_px) % SIZE_PX, int(y_px) % SIZE_PX
        # Streets of a district have lamps of one kind, mostly.
        place = np.clip(0.5 + 0.3 * district[y, x] + 0.22 * rng.standard_normal(), 0.0, 0.999)
        color = np.array(_LAMP_RGB[int(np.searchsorted(shares, place))][1])
        strength = rng.lognormal(-0.5 * _LAMP_SPREAD**2, _LAMP_SPREAD)
        light[y, x] += color * (strength * LAMP_CD * per_m2)
    # Half of the light comes from the street around the lamp.
    pool = cv2.GaussianBlur(light, (0, 0), 5.0 / texel_m)
    light = 0.4 * light + 0.6 * pool
    light = bent_like(kind, light)
    light *= np.float32(1.0 / LAMP_PEAK_CD_M2)
    # Clipping, bending and eight bits take some light: the rest makes up for it.
    sent = len(land.lamps_px) * LAMP_CD / (LAMP_PEAK_CD_M2 * (SIZE_PX * texel_m) ** 2)
    kept = np.rint(255 * np.sqrt(np.clip(light[..., 1], 0.0, 1.0))) / 255
    if kept.any():  # land without towns has no lamps
        light *= np.float32(sent / float(np.mean(kept * kept, dtype=np.float64)))
    return MipTile(np.clip(light, 0.0, 1.0), texel_m, coded=True)


def _beam_shares(height_m: Field, texel_m: float, weight: Field) -> Field:
    """(N, N, 3) light of the sun on surfaces over that on level ground, shadows included, over `BEAM_SCALE`."""
    horizon = np.zeros_like(height_m)
    for step in _SHADOW_STEPS_PX:
        rise = np.roll(height_m, -step, axis=1)
        rise -= height_m
        rise *= np.float32(1.0 / (step * texel_m))
        np.maximum(horizon, rise, out=horizon)
    slope_u = (np.roll(height_m, -1, axis=1) - np.roll(height_m, 1, axis=1)) * np.float32(_CANOPY_SLOPE / 2 / texel_m)
    slope_v = (np.roll(height_m, -1, axis=0) - np.roll(height_m, 1, axis=0)) * np.float32(_CANOPY_SLOPE / 2 / texel_m)
    length = np.sqrt(1.0 + slope_u * slope_u + slope_v * slope_v)
    shares = np.empty((*height_m.shape, 3), dtype=np.float32)
    for index, tangent in enumerate(SUN_TANGENTS):
        lit = np.clip((tangent - horizon) / np.float32(0.35 * tangent) + np.float32(0.5), 0.0, 1.0)
        share = lit * np.clip((1.0 - slope_u * np.float32(1.0 / tangent)) / length, 0.0, 1.8)
        mean = float((share * weight).mean(dtype=np.float64) / weight.mean(dtype=np.float64))
        shares[..., index] = share * np.float32(1.0 / (BEAM_SCALE * mean))
    return shares
