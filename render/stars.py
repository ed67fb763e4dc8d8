"""Stars, which are points: each shines into the four pixels around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.stereo import Eye, StereoRig
from scenes.sky.night import EXTINCTION_MAG, star_catalogue

_FAR_M = 1e9
# Towards the horizon the air takes the rest.
_LOWEST_SINE = 0.02


def add_stars(sky: NDArray[np.float32], rig: StereoRig, eye: Eye, rotation: NDArray[np.float64]) -> None:
    """Add stars to a picture of the sky, in place.

    Args:
        sky: (H, W, 3) radiance. [cd/m2]
        rig, eye: give the projection.
        rotation: (3, 3) `world_from_left`.
    """
    camera = rig.camera
    directions, lux = star_catalogue()
    in_left = np.einsum("ni,ij->nj", directions, rotation)
    widest = np.hypot(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
    ahead = (in_left[:, 2] * widest > np.hypot(in_left[:, 0], in_left[:, 1])) & (directions[:, 2] > _LOWEST_SINE)
    rays, lux, up = in_left[ahead], lux[ahead], directions[ahead, 2]
    if len(rays) == 0:
        return
    lux = lux * 10.0 ** (-0.4 * EXTINCTION_MAG * (1.0 / up - 1.0))
    # Illuminance over the solid angle of the pixel.
    level = lux * camera.fx_px * camera.fy_px / rays[:, 2] ** 3
    center = rig.project(rays * _FAR_M, eye)
    corner = np.floor(center).astype(int)
    share = center - corner
    for du in (0, 1):
        for dv in (0, 1):
            weight = np.abs(1 - du - share[:, 0]) * np.abs(1 - dv - share[:, 1])
            u, v = corner[:, 0] + du, corner[:, 1] + dv
            inside = (u >= 0) & (u < sky.shape[1]) & (v >= 0) & (v < sky.shape[0])
            np.add.at(sky, (v[inside], u[inside]), (level * weight)[inside, None].astype(np.float32))
