"""Cloud layers with depth: rays are marched through each layer's density and shaded where they hit cloud."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import CloudLayer
from scenes.clouds.cloud_density import CloudDensity
from scenes.clouds.ray_march import march
from scenes.ground_view import pixel_angle_rad
from scenes.sky.photometry import Radiance, henyey_greenstein

_Field = NDArray[np.float32]

# Distance towards the sun at which the shading of a knob samples again, over the size of the largest clouds.
_RELIEF_FRACTION = 0.008
# Droplets scatter forward; ice crystals less so.
_DROPLET_ASYMMETRY, _ICE_ASYMMETRY = 0.8, 0.72
# Two streams: a layer of optical depth t lets 1 / (1 + b t) through, b = 0.75 (1 - g) with g = 0.85 for droplets
# (Coakley and Chylek 1975, doi:10.1175/1520-0469(1975)032<0409:TTSAIR>2.0.CO;2).
BACK_SCATTER = 0.11
_LOWEST_CIRRUS_RISE = 0.08
# Standard deviations of the blur at edges and where clouds crowd, and the number of bodies between rays that crowds.
_EDGE_PX, _MEAN_PX = 0.85, 2.2
_CROWD_FROM, _CROWD_TO = 0.05, 1.0
# Size of the heaps of a sheet over that of its largest patches.
_HEAP_FRACTION = 0.3


@dataclass(frozen=True)
class CloudLight:
    """Light on a layer.

    Attributes:
        direction: (3,) towards sun or moon.
        beam_lux: (3,) illuminance of a plane that faces the beam, at the layer. [lux]
        sky_lux: (3,) illuminance of the layer from above without the beam. [lux]
        ground_lux: (3,) illuminance of the layer from below. [lux]
    """

    direction: NDArray[np.float64]
    beam_lux: NDArray[np.float64]
    sky_lux: NDArray[np.float64]
    ground_lux: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CloudLayerView:
    """One layer along every ray.

    Attributes:
        radiance: (H, W, 3) of the cloud itself, without air in front of it. [cd/m2]
        opacity: (H, W) share of the light behind it that the cloud hides.
        distance_m: (H, W) distance of the visible cloud. [m]
    """

    radiance: Radiance
    opacity: _Field
    distance_m: _Field


def diffuse_transmission(layer: CloudLayer) -> float:
    """Mean share of light that the layer transmits, direct or scattered."""
    return 1.0 - layer.cover_fraction * (1.0 - 1.0 / (1.0 + BACK_SCATTER * layer.optical_depth))


def render_cloud_layer(
    layer: CloudLayer,
    directions: NDArray[np.float32],
    light: CloudLight,
    every: int = 1,
    offset_m: tuple[float, float] = (0.0, 0.0),
    horizon_sine: float | None = None,
) -> CloudLayerView:
    """The layer along (H, W, 3) unit directions in world axes.

    Args:
        layer: its description.
        directions: neighbours in the array must be neighbours in direction if `every` is not 1.
        light: on the layer.
        every: march only one in so many rays down and across, and those at edges; every ray is shaded.
        offset_m: of the camera, east and north of the layer's origin. [m]
        horizon_sine: as in `CloudDensity`.
    """
    density = CloudDensity(layer, offset_m, horizon_sine)
    if layer.kind == "cirrus":
        return _render_cirrus(density, directions, light)
    rise = directions[..., 2] * np.float32(np.sign(layer.height_above_camera_m))
    met = march(density, directions, light.direction, every)
    place = density.place(directions, met.distance_m)
    # Knobs too fine for ray marching fray the edges and modulate the light.
    strength = density.knob_strength(place, met.distance_m * np.float32(pixel_angle_rad(directions)))
    knobs = strength * density.knobs(place)
    frayed = 1.0 - np.exp(-met.depth * np.exp(np.float32(0.9) * np.clip(knobs, -1.0, 1.0)))
    # Far clouds fade at the horizon.
    opacity = frayed * np.clip((rise - np.float32(density.least_rise)) / np.float32(density.fading_rise), 0.0, 1.0)
    return CloudLayerView(
        radiance=_shade(density, directions, (place, knobs, strength, met.towards_sun), light),
        opacity=opacity,
        distance_m=met.distance_m,
    )


def band_limited(layered: Radiance, layer: CloudLayer, directions: NDArray[np.float32]) -> Radiance:
    """An image of a layer without detail that its rays are too few to resolve.

    Edges are as wide as the distance between rays. Towards the horizon, where clouds are closer behind each other than
    rays, only their mean is left.

    Args:
        layered: (H, W, 4) light times opacity, and opacity.
        layer: its description.
        directions: (H, W, 3) rays; neighbours in the array are neighbours in direction.
    """
    if layer.kind == "cirrus":
        return layered
    sharp: Radiance = cv2.GaussianBlur(layered, (0, 0), _EDGE_PX)
    height_m = np.float32(abs(layer.height_above_camera_m))
    distance_m = height_m / np.maximum(np.abs(directions[..., 2]), np.float32(1e-3))
    # Number of bodies of cloud, or heaps of a sheet, behind each other between two rays.
    apart_m = layer.feature_size_m * (_HEAP_FRACTION if layer.kind == "stratus" else 1.0)
    crowd = distance_m * distance_m * np.float32(pixel_angle_rad(directions) / apart_m) / height_m
    share = np.clip((crowd - np.float32(_CROWD_FROM)) / np.float32(_CROWD_TO - _CROWD_FROM), 0.0, 1.0)[..., None]
    if not share.any():
        return sharp
    mean = cv2.GaussianBlur(layered, (0, 0), _MEAN_PX)
    result: Radiance = sharp + share * (mean - sharp)
    return result


def opacity_towards(
    layer: CloudLayer,
    direction: NDArray[np.float64],
    offset_m: tuple[float, float] = (0.0, 0.0),
    horizon_sine: float | None = None,
) -> float:
    """Share of the sun's or moon's beam that the layer stops on the way to the camera; see `render_cloud_layer`."""
    if direction[2] * layer.height_above_camera_m <= 0 and (horizon_sine is None or not layer.is_above):
        return 0.0
    nothing = np.zeros(3)
    light = CloudLight(direction, nothing, nothing, nothing)
    ray = direction[None, None].astype(np.float32)
    return float(render_cloud_layer(layer, ray, light, 1, offset_m, horizon_sine).opacity[0, 0])


def _shade(
    density: CloudDensity,
    directions: NDArray[np.float32],
    surface: tuple[NDArray[np.float32], _Field, _Field, _Field],
    light: CloudLight,
) -> Radiance:
    """Radiance of the visible cloud.

    Singly scattered sunlight keeps the droplets' forward peak (the silver lining) and falls off with the depth towards
    the sun; multiply scattered light reaches deeper and is even.

    Args:
        density: of the layer.
        directions: (H, W, 3) rays.
        surface: positions (H, W, 3), knobs there, their visible amplitude, and optical depth towards the sun.
        light: on the layer.
    """
    layer = density.layer
    place, knobs, strength, towards_sun = surface
    sun = light.direction.astype(np.float32)
    # A knob is bright where it is lower towards the sun.
    moved = place + sun * np.float32(_RELIEF_FRACTION * layer.feature_size_m)
    relief = knobs - strength * density.knobs(moved)
    towards_sun = towards_sun * np.exp(np.float32(-0.3) * relief)
    height = np.clip(density.height_fraction(place[..., 2]), 0.0, 1.0)
    cosine = np.einsum("...i,i->...", directions, sun)
    single = henyey_greenstein(cosine, _DROPLET_ASYMMETRY).astype(np.float32) * np.exp(-towards_sun)
    multiple = (0.5 * np.exp(-0.5 * towards_sun) + 0.36 / (1.0 + BACK_SCATTER * towards_sun)) / np.float32(np.pi)
    overhead = np.float32(layer.optical_depth) * (1.0 - height)
    from_above = (0.85 / np.pi) / (1.0 + np.float32(BACK_SCATTER) * overhead) * (0.6 + 0.4 * height)
    from_below = (0.75 / np.pi) * (1.0 - 0.75 * height)
    out = (0.6 * single + multiple)[..., None] * light.beam_lux.astype(np.float32)
    out += from_above[..., None] * light.sky_lux.astype(np.float32)
    out += from_below[..., None] * light.ground_lux.astype(np.float32)
    # Creases are darker; a sheet is brighter where it is thin.
    tone = np.clip(1.0 + np.float32(0.08) * relief + np.float32(0.05) * knobs, 0.6, 1.4)
    if layer.kind == "stratus" and layer.is_above:
        tone = np.exp(density.mottling(place))
    result: Radiance = (out * tone[..., None]).astype(np.float32)
    return result


def _render_cirrus(density: CloudDensity, directions: NDArray[np.float32], light: CloudLight) -> CloudLayerView:
    """Ice cloud without depth: thin enough for single scattering plus an even share."""
    rise = directions[..., 2] * np.float32(np.sign(density.layer.height_above_camera_m))
    near_m, _ = density.crossing(rise)
    depth = density.cirrus_depth(directions, near_m)
    opacity = 1.0 - np.exp(-depth / np.maximum(rise, np.float32(_LOWEST_CIRRUS_RISE)))
    opacity[rise <= density.least_rise] = 0.0
    cosine = np.einsum("...i,i->...", directions, light.direction.astype(np.float32))
    single = 0.7 * henyey_greenstein(cosine, _ICE_ASYMMETRY) + 0.3 / (4.0 * np.pi) + 0.1 / np.pi
    even = (light.sky_lux + light.ground_lux) / (2.0 * np.pi)
    radiance = single[..., None].astype(np.float32) * light.beam_lux.astype(np.float32) + even.astype(np.float32)
    return CloudLayerView(radiance=radiance.astype(np.float32), opacity=opacity, distance_m=near_m)
