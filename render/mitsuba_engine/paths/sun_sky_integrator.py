"""Paths under a sun and a sky: the sun is looked at from every surface, the sky is where a path ends.

Mitsuba's own integrator picks one of its lights by lot at every surface, which makes sunlit surfaces noisy. The sun is
one direction and needs no lot. Of the sky's light on a part that stands in the open, most is known beforehand: what it
would be with nothing in the way. Paths add what parts that do stand in the way send instead, and take away what they
hide; the sum has the same mean as without this detour, and hardly any noise where little is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from render.mitsuba_engine.sky_irradiance import SkyIrradiance


@dataclass(frozen=True, eq=False)
class Lights:
    """What shines on the stage.

    Attributes:
        to_sun: direction towards the sun, in the stage's axes.
        sun_lux: illuminance of a plane that faces it.
        sky: its light on plates in the open.
        in_open: by the registry number of a shape, 1 where light from the open sky is taken as known, else 0.
        lit: whether parts shine by themselves.
    """

    to_sun: Any
    sun_lux: Any
    sky: SkyIrradiance
    in_open: Any
    lit: bool


def trace_first(scene: Any, lights: Lights, ray: Any) -> tuple[Any, Any, Any, Any]:
    """What the surface that rays meet sends from lamps, sun and, for parts in the open, an unhidden sky.

    Returns:
        Radiance (0 for rays that meet nothing), whether a ray meets something, the surface, and which share of the
        unhidden sky's light is in the radiance.
    """
    surface = scene.ray_intersect(ray, mi.RayFlags.All, True)
    hit = surface.is_valid()
    radiance = _own_and_sunlight(scene, lights, surface, hit)
    number: Any = dr.reinterpret_array(mi.UInt32, surface.shape)
    known = dr.gather(mi.Float, lights.in_open, number, hit)
    front = hit & (surface.wi.z > 0)
    reflectance = surface.bsdf(ray).eval_diffuse_reflectance(surface, front)
    radiance += dr.select(front, known * reflectance * lights.sky.towards(surface.sh_frame.n), 0.0)
    return radiance, hit, surface, known


def trace_rest(scene: Any, lights: Lights, sampler: Any, first: tuple[Any, Any, Any], max_depth: int) -> Any:
    """What `trace_first` leaves out: light by way of other surfaces, and the sky less what was taken as known.

    Args:
        scene: with its environment map.
        lights: that shine on it.
        sampler: seeded for the wavefront.
        first: surface, whether it is one, and the share of the sky's light that is known, from `trace_first`.
        max_depth: the longest path in segments.

    Returns:
        Radiance; may be negative, and is not on average.
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
        total += weight * _sky_seen(scene, ray, active, hit, known)
        total += weight * _own_and_sunlight(scene, lights, surface, hit)
        active, known = hit, mi.Float(0.0)
    sample, share = surface.bsdf().sample(context, surface, sampler.next_1d(), sampler.next_2d(), active)
    weight *= share
    active &= dr.max(weight) > 0.0
    ray = surface.spawn_ray(surface.to_world(sample.wo))
    hit = active & scene.ray_test(ray, active)
    total += weight * _sky_seen(scene, ray, active, hit, known)
    return dr.select(dr.isfinite(total), total, 0.0)


def _own_and_sunlight(scene: Any, lights: Lights, surface: Any, hit: Any) -> Any:
    """Radiance of surfaces towards where they are seen from, by lamps and by sunlight alone."""
    towards = surface.to_local(lights.to_sun)
    in_sun = hit & (towards.z > 0) & (surface.wi.z > 0)
    in_sun &= ~scene.ray_test(surface.spawn_ray(lights.to_sun), in_sun)
    radiance = lights.sun_lux * surface.bsdf().eval(mi.BSDFContext(), surface, towards, in_sun)
    if lights.lit:
        radiance += surface.emitter(scene).eval(surface, hit)
    return radiance


def _sky_seen(scene: Any, ray: Any, active: Any, hit: Any, known: Any) -> Any:
    """The sky at the end of rays that meet nothing, less the share of it that is known already."""
    end = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.d))
    end.wi = -ray.d
    seen = dr.select(hit, -known, 1.0 - known)
    return seen * scene.environment().eval(end, active & (seen != 0.0))
