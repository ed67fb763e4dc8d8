"""Light of the whole sky and ground on a small plate, by the plate's direction: the sky without shadows.

A surface that sees all of the sky has exactly this light; paths then have to find only what stands in the sky's way.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from render.mitsuba_engine.jit_arrays import jit_tensor
from scenes.sky.light import Radiance

# Light by direction of the plate is so smooth that linear interpolation between 3.75 degrees errs by 5e-4 at most.
_ROWS = 48
# Directions that the light is summed over: a cosine varies over a block of 4 x 4 texels of 1.4 degrees by 1e-3.
_BLOCK_PX = 4


def as_mitsuba_reads(light_map: Radiance) -> Radiance:
    """A light map with texel centres half a texel inside, as one whose first and last rows are zenith and nadir.

    Mitsuba stretches maps that way; taken as they are, they would come out up to half a texel off.
    """
    height = light_map.shape[0]
    place = np.clip(np.arange(height) * height / (height - 1) - 0.5, 0, height - 1)
    above = np.minimum(place.astype(np.intp), height - 2)
    share = (place - above).astype(np.float32)[:, None, None]
    result: Radiance = light_map[above] * (1 - share) + light_map[above + 1] * share
    return result


def irradiance_map(light: Radiance) -> Radiance:
    """Mean radiance that a plate receives, weighted by the cosine, for plates of all directions.

    Args:
        light: (128, 256, 3) equirectangular map whose first and last rows are zenith and nadir, as Mitsuba reads it.

    Returns:
        (48, 96, 3) map with texel centres half a texel inside: irradiance over pi. [cd/m2]
    """
    weights = _row_weights(light.shape[0])
    rows, columns = light.shape[0] // _BLOCK_PX, light.shape[1] // _BLOCK_PX
    blocks = (light * weights[:, None, None]).reshape(rows, _BLOCK_PX, columns, _BLOCK_PX, 3).sum(axis=(1, 3))
    result: Radiance = _cosines(light.shape[0]) @ blocks.reshape(-1, 3).astype(np.float32)
    plates: Radiance = result.reshape(_ROWS, 2 * _ROWS, 3)
    return plates


def _row_weights(height: int) -> Array:
    """(height,) solid angle of the texels of each row, up to a factor."""
    polar = np.arange(height) * np.pi / (height - 1)
    weights: Array = np.sin(polar)
    # The last rows are caps of half a texel.
    weights[[0, -1]] = np.pi / (height - 1) / 8
    return weights


@lru_cache(maxsize=1)
def _cosines(height: int) -> NDArray[np.float32]:
    """(plates, blocks) what a block of texels counts for a plate; each plate's row sums to 1 under an even sky."""
    weights = _row_weights(height)
    rows = height // _BLOCK_PX
    polar = np.arange(height) * np.pi / (height - 1)
    share = weights.reshape(rows, _BLOCK_PX)
    middle = (share * polar.reshape(rows, _BLOCK_PX)).sum(axis=1) / share.sum(axis=1)
    blocks = _directions(middle, 2 * height // _BLOCK_PX)
    plates = _directions((np.arange(_ROWS) + 0.5) * np.pi / _ROWS, 2 * _ROWS)
    cosines = np.maximum(plates @ blocks.T, 0.0)
    totals = cosines @ np.repeat(share.sum(axis=1) * _BLOCK_PX, 2 * height // _BLOCK_PX)
    result: NDArray[np.float32] = (cosines / totals[:, None]).astype(np.float32)
    return result


def _directions(polar: Array, columns: int) -> Array:
    """(rows * columns, 3) unit vectors of an equirectangular grid."""
    p, a = np.meshgrid(polar, (np.arange(columns) + 0.5) * 2 * np.pi / columns, indexing="ij")
    directions: Array = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    return directions.reshape(-1, 3)


class SkyIrradiance:
    """Irradiance over pi by the direction of a plate in the stage's axes."""

    def __init__(self, light: Radiance, world_from_stage: Array) -> None:
        """From a light map (see `irradiance_map`) and the (3, 3) rotation into its axes."""
        plates = irradiance_map(light)
        wrapped = np.concatenate([plates[:, -1:], plates, plates[:, :1]], axis=1)
        self._columns = plates.shape[1]
        # The type is chosen with the variant, which type checkers do not see.
        texture: Any = mi.Texture2f
        self._texture = texture(jit_tensor(wrapped), wrap_mode=dr.WrapMode.Clamp)
        # Plain numbers would become part of the compiled kernel.
        self._rotation = [[dr.opaque(mi.Float, float(value)) for value in row] for row in world_from_stage]

    def towards(self, normal: Any) -> Any:
        """Irradiance over pi of plates with these unit normals. [cd/m2]"""
        x, y, z = (row[0] * normal.x + row[1] * normal.y + row[2] * normal.z for row in self._rotation)
        turn = dr.atan2(y, x) / (2 * dr.pi)
        u = ((turn - dr.floor(turn)) * self._columns + 1) / (self._columns + 2)
        red, green, blue = self._texture.eval(mi.Point2f(u, dr.safe_acos(z) / dr.pi))
        return mi.Color3f(red, green, blue)
