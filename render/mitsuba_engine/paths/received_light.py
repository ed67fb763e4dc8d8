"""Light that points on matt surfaces receive, bounce by bounce: `trace_residual` over the reflectance, for less time.

What comes after the first reflection is a small share of the light on dark parts. So a path goes on only by chance, in
proportion to the reflectance of what it meets, and counts the more (Russian roulette: J. Arvo and D. Kirk, Particle
transport and image synthesis, SIGGRAPH 1990, doi:10.1145/97880.97886). Those that go on are put together, so that the
others cost nothing more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from render.mitsuba_engine.paths.rays import FrameRays
from render.mitsuba_engine.paths.sun_sky_integrator import emitted_and_sunlight, unknown_sky

# A path goes on so often over the reflectance: paths after the first reflection are as noisy as they are many, and
# with white and grey cloth their error is least for the time at two thirds to four fifths.
_GOES_ON_PER_REFLECTANCE, _LEAST_GOES_ON = 0.7, 0.05
# Mitsuba's own distance of a ray's origin from its surface, over the size of the coordinates.
_OFFSET = 1500 * 2.0**-23


@dataclass(frozen=True, eq=False)
class MattPoints:
    """N points on matt surfaces.

    Attributes:
        place: where they are. [m]
        facing: normals of the triangles.
        normal: normals by which they are lit.
        known: shares of the unobstructed sky's light that are known, 0 or 1.
    """

    place: Any
    facing: Any
    normal: Any
    known: Any

    def at(self, row: Any) -> MattPoints:
        """The points of these rows."""
        place, facing, normal = (
            dr.gather(mi.Vector3f, values, row) for values in (self.place, self.facing, self.normal)
        )
        return MattPoints(place, facing, normal, dr.gather(mi.Float, self.known, row))


def matt_points(surface: Any, known: Any) -> MattPoints:
    """What rays hit, with known shares of the unobstructed sky's light."""
    place, facing, normal = (mi.Vector3f(values) for values in (surface.p, surface.n, surface.sh_frame.n))
    return MattPoints(place, facing, normal, known)


def trace_received(rays: FrameRays, points: MattPoints, first: Any, max_depth: int) -> list[Any]:
    """Irradiance over pi by one path from each point, less the light of the sky that is known.

    Args:
        rays: of the frame.
        points: where the paths start.
        first: 2-D random numbers of the first directions.
        max_depth: longest path in segments, from the camera.

    Returns:
        3 arrays by the points. [cd/m2]
    """
    count = dr.width(first)
    total = [dr.zeros(mi.Float, count) for _ in range(3)]
    lane, weight = dr.arange(mi.UInt32, count), mi.Color3f(1.0)
    for bounce in range(max_depth - 1):
        sampler = rays.sampler(dr.width(lane), 1)
        ray = _towards(points, first if bounce == 0 else sampler.next_2d())
        if bounce == max_depth - 2:
            _add(total, weight * _sky_along(rays, ray, points.known, mi.Bool(True)), lane)
            break
        surface = rays.scene.ray_intersect(ray, mi.RayFlags.All, False)
        hit = surface.is_valid()
        light = unknown_sky(rays.scene, ray, mi.Bool(True), hit, points.known)
        light += emitted_and_sunlight(rays.scene, rays.lights, surface, hit, rays.lights.lights_others)
        front = hit & (surface.wi.z > 0)
        share = surface.bsdf().eval_diffuse_reflectance(surface, front)
        goes_on = dr.clip(_GOES_ON_PER_REFLECTANCE * dr.max(share), _LEAST_GOES_ON, 1.0)
        light, next_weight = weight * light, weight * share / goes_on
        alive = front & (sampler.next_1d() < goes_on)
        met = matt_points(surface, dr.zeros(mi.Float, dr.width(ray.d)))
        # Otherwise each use of them would trace the rays again.
        dr.eval(light, next_weight, alive, met)
        _add(total, light, lane)
        row: Any = dr.compress(alive)
        if not dr.width(row):
            break
        points = met.at(row)
        weight, lane = dr.gather(mi.Color3f, next_weight, row), dr.gather(mi.UInt32, lane, row)
    dr.eval(total)
    return total


def sky_received(rays: FrameRays, points: MattPoints, first: Any, active: Any) -> Any:
    """The same by the sky alone: other surfaces only hide it.

    Args:
        rays: of the frame.
        points: where the paths start.
        first: 2-D random numbers of the directions.
        active: which paths are wanted; the others give 0.

    Returns:
        Irradiance over pi by the points. [cd/m2]
    """
    return _sky_along(rays, _towards(points, first), points.known, active)


def sky_seen_and_hidden(rays: FrameRays, points: MattPoints, first: Any) -> tuple[Any, Any]:
    """Radiance of the sky along one path from each point, where it is seen and where something hides it. [cd/m2]

    Args:
        rays, points, first: as for `sky_received`.

    Returns:
        By the points, 0 where it is hidden; 0 where it is seen.
    """
    ray = _towards(points, first)
    hit = rays.scene.ray_test(ray, mi.Bool(True))
    sky = unknown_sky(rays.scene, ray, mi.Bool(True), mi.Bool(False), mi.Float(0.0))
    return dr.select(hit, 0.0, sky), dr.select(hit, sky, 0.0)


def _sky_along(rays: FrameRays, ray: Any, known: Any, active: Any) -> Any:
    return unknown_sky(rays.scene, ray, active, rays.scene.ray_test(ray, active), known)


def _towards(points: MattPoints, numbers: Any) -> Any:
    """Rays from points in directions by the cosine to their normals."""
    direction = mi.Frame3f(points.normal).to_world(mi.warp.square_to_cosine_hemisphere(numbers))
    away = (1.0 + dr.max(dr.abs(points.place))) * _OFFSET
    away = dr.select(dr.dot(points.facing, direction) < 0, -away, away)
    return mi.Ray3f(mi.Point3f(points.place + away * points.facing), direction)


def _add(total: list[Any], light: Any, lane: Any) -> None:
    """Add the light of paths to those that they started as."""
    finite = dr.isfinite(light)
    for channel, values, good in zip(total, light, finite, strict=True):
        dr.scatter_reduce(dr.ReduceOp.Add, channel, dr.select(good, values, 0.0), lane)
