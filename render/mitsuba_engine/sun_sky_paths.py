"""Paths under a sun and a sky: the sun is looked at from every surface, the sky is where a path ends.

Mitsuba's own integrator picks one of its lights by lot at every surface, which makes sunlit surfaces noisy. The sun is
one direction and needs no lot; the sky without it is so even that the surface's own choice of direction serves best.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def trace_paths(scene: Any, sun: tuple[Any, Any], sampler: Any, ray: Any, plan: tuple[int, bool]) -> tuple[Any, Any]:
    """Light along rays from all that they meet, without the sky behind it.

    Args:
        scene: with its environment map.
        sun: direction towards it, and its illuminance of a facing plane.
        sampler: seeded for the wavefront.
        ray: camera rays.
        plan: the longest path in segments, and whether parts shine by themselves.

    Returns:
        Radiance, 0 for rays that meet nothing, and whether a ray meets something.
    """
    max_depth, lit = plan
    to_sun, illuminance = sun
    context = mi.BSDFContext()
    total, weight = mi.Color3f(0.0), mi.Color3f(1.0)
    active, covered = mi.Bool(True), mi.Bool(False)
    for depth in range(max_depth - 1):
        surface = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
        hit = active & surface.is_valid()
        if depth == 0:
            covered = hit
        else:
            total += weight * scene.environment().eval(surface, active & ~hit)
        if lit:
            total += weight * surface.emitter(scene).eval(surface, hit)
        material = surface.bsdf(ray)
        in_sun = hit & ~scene.ray_test(surface.spawn_ray(to_sun), hit)
        total += weight * illuminance * material.eval(context, surface, surface.to_local(to_sun), in_sun)
        sample, share = material.sample(context, surface, sampler.next_1d(), sampler.next_2d(), hit)
        weight *= share
        active = hit & (dr.max(weight) > 0.0)
        ray = surface.spawn_ray(surface.to_world(sample.wo))
    ended = dr.zeros(mi.SurfaceInteraction3f, dr.width(active))
    ended.wi = -ray.d
    total += weight * scene.environment().eval(ended, active & ~scene.ray_test(ray, active))
    return dr.select(covered, total, 0.0), covered
