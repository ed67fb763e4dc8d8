"""Path tracing under a sun and a sky.

Mitsuba's own integrator picks one light at random at every surface, which makes sunlit surfaces noisy. Here every
surface samples the sun directly, because the sun is a single direction, and a path ends in the sky.

Most of the sky's light on a part in the open is known in advance: it is the irradiance of an unobstructed sky, a
function of the surface normal alone (`SkyIrradiance`). Paths add the light that obstructing parts send instead and
subtract the sky that they hide. The sum has the same mean as without this control variate, and hardly any noise where
little of the sky is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from render.mitsuba_engine.jit_arrays import jit_tensor
from scenes.sky.photometry import Radiance

# Irradiance varies so smoothly with the normal that linear interpolation over 3.75 degrees errs by at most 5e-4.
_ROWS = 48
# The integral sums over blocks of 4 x 4 texels of 1.4 degrees, over which a cosine varies by 1e-3.
_BLOCK_PX = 4


@dataclass(frozen=True, eq=False)
class SceneLights:
    """The lights of a scene.

    Attributes:
        to_sun: direction towards the sun, in the stage's axes.
        sun_lux: illuminance of a plane that faces the sun. [lux]
        sky: irradiance by the unobstructed sky.
        open_to_sky: by the registry number of a shape, 1 where light from the whole sky is taken as known, else 0.
        parts_emit: whether any part is a lamp.
        lights_others: by the registry number of a shape, 1 where paths from other surfaces find what it emits, else 0;
            None where it is 1 for all lamps. A path that meets a lamp of a few centimetres would leave a speckle.
    """

    to_sun: Any
    sun_lux: Any
    sky: SkyIrradiance
    open_to_sky: Any
    parts_emit: bool
    lights_others: Any = None


def trace_direct(scene: Any, lights: SceneLights, ray: Any) -> tuple[Any, Any, Any, Any]:
    """Direct light of the first surface that rays hit: lamps, sun and, for parts open to the sky, an unobstructed sky.

    Returns:
        Radiance (0 for rays that miss), whether a ray hits something, the surface, and the share of the unobstructed
        sky's light that the radiance holds.
    """
    surface = scene.ray_intersect(ray, mi.RayFlags.All, True)
    hit = surface.is_valid()
    radiance = emitted_and_sunlight(scene, lights, surface, hit)
    number: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
    known = dr.gather(mi.Float, lights.open_to_sky, number, hit)
    front = hit & (surface.wi.z > 0)
    reflectance = surface.bsdf(ray).eval_diffuse_reflectance(surface, front)
    radiance += dr.select(front, known * reflectance * lights.sky.towards(surface.sh_frame.n), 0.0)
    return radiance, hit, surface, known


def trace_residual(scene: Any, lights: SceneLights, sampler: Any, first: tuple[Any, Any, Any], max_depth: int) -> Any:
    """The light that `trace_direct` leaves out: by reflection from other surfaces, and the sky less its known light.

    Args:
        scene: has an environment map.
        lights: of the scene.
        sampler: seeded for the wavefront.
        first: surface, whether it was hit, and the known share of the sky's light, as from `trace_direct`.
        max_depth: longest path in segments.

    Returns:
        Radiance; single samples may be negative.
    """
    surface, active, known = first
    context = mi.BSDFContext()
    total, weight = mi.Color3f(0.0), mi.Color3f(1.0)
    for _ in range(max_depth - 2):
        sample, share = surface.bsdf().sample(context, surface, sampler.next_1d(), sampler.next_2d(), active)
        weight *= share
        active &= dr.max(weight) > 0.0
        ray = surface.spawn_ray(surface.to_world(sample.wo))
        surface = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        hit = active & surface.is_valid()
        total += weight * unknown_sky(scene, ray, active, hit, known)
        total += weight * emitted_and_sunlight(scene, lights, surface, hit, lights.lights_others)
        active, known = hit, mi.Float(0.0)
    sample, share = surface.bsdf().sample(context, surface, sampler.next_1d(), sampler.next_2d(), active)
    weight *= share
    active &= dr.max(weight) > 0.0
    ray = surface.spawn_ray(surface.to_world(sample.wo))
    hit = active & scene.ray_test(ray, active)
    total += weight * unknown_sky(scene, ray, active, hit, known)
    return dr.select(dr.isfinite(total), total, 0.0)


def emitted_and_sunlight(scene: Any, lights: SceneLights, surface: Any, hit: Any, shown: Any = None) -> Any:
    """Radiance of surfaces towards the ray's origin, by lamps and by sunlight alone; `shown` is a factor by shape."""
    towards = surface.to_local(lights.to_sun)
    in_sun = hit & (towards.z > 0) & (surface.wi.z > 0)
    in_sun &= ~scene.ray_test(surface.spawn_ray(lights.to_sun), in_sun)
    radiance = lights.sun_lux * surface.bsdf().eval(mi.BSDFContext(), surface, towards, in_sun)
    if lights.parts_emit:
        # `surface.emitter` also gives the sky, whose registry number in this scene would become part of the kernel.
        emitted = surface.shape.emitter().eval(surface, hit)
        if shown is not None:
            number: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
            emitted *= dr.gather(mi.Float, shown, number, hit)
        radiance += emitted
    return radiance


def unknown_sky(scene: Any, ray: Any, active: Any, hit: Any, known: Any) -> Any:
    """The sky's radiance along rays that miss, less the share of it that is already counted as known."""
    end = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
    end.wi = -ray.d
    seen = dr.select(hit, -known, 1.0 - known)
    return seen * scene.environment().eval(end, active & (seen != 0.0))


def irradiance_map(light: Radiance) -> Radiance:
    """Irradiance over pi of plates of all directions.

    Args:
        light: (128, 256, 3) equirectangular map whose first and last rows are zenith and nadir, as Mitsuba reads it.

    Returns:
        (48, 96, 3) map by direction of the normal, with texel centres half a texel inside. [cd/m2]
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
    """(plates, blocks) weight of each block of texels for each plate; the weights of a plate sum to 1."""
    weights = _row_weights(height)
    rows = height // _BLOCK_PX
    polar = np.arange(height) * np.pi / (height - 1)
    share = weights.reshape(rows, _BLOCK_PX)
    middle = (share * polar.reshape(rows, _BLOCK_PX)).sum(axis=1) / share.sum(axis=1)
    blocks = _directions(middle, 2 * height // _BLOCK_PX)
    plates = _directions((np.arange(_ROWS) + 0.5) * np.pi / _ROWS, 2 * _ROWS)
    cosines = plates @ blocks.T
    np.maximum(cosines, 0.0, out=cosines)
    totals = cosines @ np.repeat(share.sum(axis=1) * _BLOCK_PX, 2 * height // _BLOCK_PX)
    result: NDArray[np.float32] = np.empty(cosines.shape, dtype=np.float32)
    # Rounded once, behind a division of doubles.
    np.divide(cosines, totals[:, None], out=result, casting="same_kind")
    return result


def _directions(polar: Array, columns: int) -> Array:
    """(rows * columns, 3) unit vectors of an equirectangular grid."""
    p, a = np.meshgrid(polar, (np.arange(columns) + 0.5) * 2 * np.pi / columns, indexing="ij")
    directions: Array = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    return directions.reshape(-1, 3)


class SkyIrradiance:
    """Irradiance over pi by an unobstructed sky and ground, by the direction of the normal in the stage's axes."""

    def __init__(self, light: Radiance, world_from_stage: Array) -> None:
        """Take a light map (see `irradiance_map`) and the (3, 3) rotation into its axes."""
        plates = irradiance_map(light)
        wrapped = np.concatenate([plates[:, -1:], plates, plates[:, :1]], axis=1)
        self._columns = plates.shape[1]
        # The type is chosen with the variant, which type checkers do not see.
        texture: Any = mi.Texture2f
        # A GPU's own interpolation counts in 256ths of a texel.
        self._texture = texture(jit_tensor(wrapped), use_accel=False, wrap_mode=dr.WrapMode.Clamp)
        # Python numbers would become part of the compiled kernel.
        self._rotation = [[dr.opaque(mi.Float, float(value)) for value in row] for row in world_from_stage]

    def towards(self, normal: Any) -> Any:
        """Irradiance over pi of plates with these unit normals. [cd/m2]"""
        x, y, z = (row[0] * normal.x + row[1] * normal.y + row[2] * normal.z for row in self._rotation)
        turn = dr.atan2(y, x) / (2 * dr.pi)
        u = ((turn - dr.floor(turn)) * self._columns + 1) / (self._columns + 2)
        red, green, blue = self._texture.eval(mi.Point2f(u, dr.safe_acos(z) / dr.pi))
        return mi.Color3f(red, green, blue)
