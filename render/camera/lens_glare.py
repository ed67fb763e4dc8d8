"""Light of the sun that the lens scatters over the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from render.engine import EyeRadiance
from scenes.environment_radiance import surroundings
from scenes.sky.light import SUN_RADIUS_RAD

# Polished and coated glass scatters 1 / (a^2 + theta^2) around a source (the ABg law of optical
# design with g = 2); the core is our choice for a lens of several elements.
_CORE_RAD = 0.01
_WIDEST_RAD = np.pi / 2
# A hood shades the front lens from suns this far outside the axis: full shade beyond the second angle.
_HOOD_BEGINS_RAD, _HOOD_ENDS_RAD = np.radians(25.0), np.radians(45.0)
_DARKEST_LUX = 1.0


def glare_spread_per_sr(angle_rad: NDArray[np.float32], scattered_fraction: float) -> NDArray[np.float32]:
    """Veiling luminance per illuminance of the lens, by the angle from the source. [1/sr]

    Its integral over the half sphere before the lens, for small angles, is the scattered fraction.
    """
    inside = np.log1p((_WIDEST_RAD / _CORE_RAD) ** 2)
    level = scattered_fraction / (np.pi * inside)
    spread: NDArray[np.float32] = (level / (np.float32(_CORE_RAD**2) + angle_rad * angle_rad)).astype(np.float32)
    return spread


def sun_glare(frame: FrameSpec, seen: EyeRadiance) -> NDArray[np.float32] | None:
    """(H, W, 3) veil of an eye by the sun or moon in or near its view, or None where there is none. [cd/m2]

    What stands before the disc takes its share of the glare; both eyes look along the same axes.

    Args:
        frame: gives sun, camera and attitude at mid-exposure.
        seen: coverage counts, for what hides the sun.
    """
    around, camera = surroundings(frame.environment), frame.rig.camera
    illuminance_lux = around.beam_illuminance_lux
    to_sun = frame.world_from_left.inverse().rotate(around.beam_direction)
    off_axis = float(np.arccos(np.clip(to_sun[2], -1.0, 1.0)))
    if off_axis >= _HOOD_ENDS_RAD or illuminance_lux.max() < _DARKEST_LUX:
        return None
    shade = np.clip((_HOOD_ENDS_RAD - off_axis) / (_HOOD_ENDS_RAD - _HOOD_BEGINS_RAD), 0.0, 1.0)
    falling = illuminance_lux * to_sun[2] * shade * _open_share(frame, seen, to_sun)
    if falling.max() < _DARKEST_LUX:
        return None
    x = ((np.arange(camera.width_px) - camera.cx_px) / camera.fx_px).astype(np.float32)
    y = ((np.arange(camera.height_px) - camera.cy_px) / camera.fy_px).astype(np.float32)[:, None]
    sun = to_sun.astype(np.float32)
    cosine = (x * sun[0] + y * sun[1] + sun[2]) / np.sqrt(1.0 + x * x + y * y)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    spread = glare_spread_per_sr(angle, frame.sensor.optics.scattered_fraction)
    veil: NDArray[np.float32] = spread[..., None] * falling.astype(np.float32)
    return veil


def _open_share(frame: FrameSpec, seen: EyeRadiance, to_sun: NDArray[np.float64]) -> float:
    """Share of the disc that nothing hides; 1 for a sun outside the picture."""
    camera = frame.rig.camera
    center = camera.project(to_sun)
    if not camera.contains(center):
        return 1.0
    radius_px = SUN_RADIUS_RAD * camera.fx_px
    low = np.maximum(np.floor(center - radius_px), 0).astype(int)
    high = np.ceil(center + radius_px).astype(int) + 1
    covered = seen.coverage[low[1] : high[1], low[0] : high[0]]
    return 1.0 - float(covered.mean())
