"""The background at camera resolution (sky, stars, clouds, ground), and the air in front of objects.

Ideal eyes share their ray directions, so one image serves both.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from geometry.bilinear_sampling import sample_bilinear
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.stereo import Eye, StereoRig
from scenes.environment_radiance import EnvironmentRadiance, environment_radiance
from scenes.sky.sky_models import EXTINCTION_MAG, star_catalogue

_FAR_M = 1e9
# Nearer to the horizon the air hides stars.
_LOWEST_SINE = 0.02
# The clear sky varies over many degrees; the paper's camera has 37 px a degree.
_COARSE_STEP_PX = 8
_MOST_BLUR_SAMPLES = 8
# By day stars drown in the sky. [deg]
_STARS_BELOW_DEG = -5.0
# Airlight varies over tens of degrees.
_AIR_STEP_PX = 32
_MOST_REMAP_ROWS = 32_000


def _directions(camera: PinholeCamera, rotation: NDArray[np.float64], u: NDArray, v: NDArray) -> NDArray[np.float32]:  # type: ignore[type-arg]
    """(len(v), len(u), 3) unit directions in world axes through the grid of pixel coordinates u, v."""
    x = ((u - camera.cx_px) / camera.fx_px).astype(np.float32)
    y = ((v - camera.cy_px) / camera.fy_px).astype(np.float32)
    r = rotation.astype(np.float32)
    inverse_length = 1.0 / np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
    out = np.empty((len(v), len(u), 3), dtype=np.float32)
    for axis in range(3):
        out[..., axis] = (r[axis, 0] * x[None, :] + (r[axis, 1] * y + r[axis, 2])[:, None]) * inverse_length
    return out


def _lens_directions(lens: Lens, rotation: NDArray[np.float64], step_px: int) -> NDArray[np.float32]:
    """The same through the pixels of an eye with a lens; `step_px` as in `lens_rays`."""
    directions: NDArray[np.float32] = np.einsum("ij,hwj->hwi", rotation.astype(np.float32), lens_rays(lens, step_px))
    return directions


# Both eyes in three steps.
@lru_cache(maxsize=6)
def lens_rays(lens: Lens, step_px: int) -> NDArray[np.float32]:
    """(h, w, 3) unit directions in the rectified axes of the eye, through every pixel or the grid of `_grid_px`."""
    camera = lens.camera
    u, v = (_grid_px(size, step_px) for size in (camera.width_px, camera.height_px))
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    try:
        rays = lens.rays(pixels)
    except ValueError:
        # The lens folds between the border of the image and the grid's end.
        rays = lens.rays(np.clip(pixels, -0.5, [camera.width_px - 0.5, camera.height_px - 0.5]))
    result: NDArray[np.float32] = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return result


def _grid_px(size_px: int, step_px: int) -> NDArray[np.float64]:
    """Coordinates of all pixels, or of the centres of squares of pixels with one more at either end. [px]"""
    if step_px == 1:
        return np.arange(size_px, dtype=float)
    return (np.arange(-(-size_px // step_px) + 2) - 0.5) * step_px - 0.5


def _sharp_background(
    ambient: EnvironmentRadiance, rig: StereoRig, eye: Eye, rotation: NDArray[np.float64]
) -> NDArray[np.float32]:
    camera, lens, step = rig.camera, rig.lens(eye), _COARSE_STEP_PX

    def through(step_px: int) -> NDArray[np.float32]:
        if lens is not None:
            return _lens_directions(lens, rotation, step_px)
        u, v = (_grid_px(size, step_px) for size in (camera.width_px, camera.height_px))
        return _directions(camera, rotation, u, v)

    window = slice(step, step + camera.height_px), slice(step, step + camera.width_px)
    sky, horizon = (
        np.maximum(cv2.resize(image, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)[window], 0.0)
        for image in ambient.clear_radiance(through(step))
    )
    if ambient.environment.sun_elevation_deg < _STARS_BELOW_DEG:
        add_stars(sky, rig, eye, rotation)
    directions = through(1)
    image = ambient.radiance(directions, sky, horizon)
    ambient.add_discs(image, directions)
    return image


def air_in_front(
    frame: FrameSpec, eye: Eye, pixel: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Airlight and extinction along pixel centres, the same in two ideal eyes.

    Args:
        frame: gives air and camera at mid-exposure.
        eye: whose pixels.
        pixel: (P,) flat indices.

    Returns:
        (P, 3) radiance of infinitely deep air in the pixel's direction [cd/m2], and (P,) optical depth per planar
        depth. [1/m]
    """
    ambient, camera, lens = environment_radiance(frame.environment), frame.rig.camera, frame.rig.lens(eye)
    rotation, step = frame.world_from_left.rotation, _AIR_STEP_PX
    v, u = (index.astype(np.float32) for index in np.divmod(pixel, camera.width_px))
    # Rows and columns of the coarse grid.
    across, down = u * np.float32(1 / step), v * np.float32(1 / step)
    if lens is None:
        columns, rows = camera.width_px // step + 2, camera.height_px // step + 2
        directions = _directions(camera, rotation, np.arange(columns) * step, np.arange(rows) * step)
        x, y = (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px
        length = np.sqrt(1.0 + x * x + y * y)
    else:
        directions = _lens_directions(lens, rotation, step)
        first = np.float32((0.5 + 0.5 * step) / step)
        across, down = across + first, down + first
        length = 1.0 / lens_rays(lens, 1).reshape(-1, 3)[pixel, 2]
    coarse = ambient.airlight(directions)
    # remap takes at most 2^15 rows or columns.
    light = np.empty((len(pixel), 3), dtype=np.float32)
    for begin in range(0, len(pixel), _MOST_REMAP_ROWS):
        part = slice(begin, begin + _MOST_REMAP_ROWS)
        light[part] = sample_bilinear(coarse, across[part, None], down[part, None])[:, 0]
    return light, (ambient.extinction_per_m * length).astype(np.float32)


def backgrounds(frame: FrameSpec) -> dict[Eye, NDArray[np.float32]]:
    """`background` of both eyes; one array where both are ideal."""
    left = background(frame, "left")
    return {"left": left, "right": left if frame.rig.lenses is None else background(frame, "right")}


def background(frame: FrameSpec, eye: Eye = "left") -> NDArray[np.float32]:
    """What an eye sees of the environment where no object is in front of it; ideal eyes see the same.

    Returns:
        (H, W, 3) radiance at pixel centres, averaged over the exposure while the camera turns. [cd/m2]
    """
    ambient = environment_radiance(frame.environment)
    turn_px = float(np.linalg.norm(frame.left_twist_per_s[3:])) * frame.exposure.time_s * frame.rig.camera.fx_px
    samples = int(np.clip(np.ceil(2 * turn_px), 1, _MOST_BLUR_SAMPLES)) if turn_px > 0.1 else 1
    total: NDArray[np.float32] | None = None
    for index in range(samples):
        offset_s = ((index + 0.5) / samples - 0.5) * frame.exposure.time_s
        image = _sharp_background(ambient, frame.rig, eye, frame.world_from_left_at(offset_s).rotation)
        total = image if total is None else total + image
    assert total is not None
    return total / np.float32(samples)


def add_stars(sky: NDArray[np.float32], rig: StereoRig, eye: Eye, rotation: NDArray[np.float64]) -> None:
    """Add stars to an image of the sky, in place; each lights the four pixels around it.

    Args:
        sky: (H, W, 3) radiance. [cd/m2]
        rig, eye: for the projection.
        rotation: (3, 3) `world_from_left`.
    """
    camera, lens = rig.camera, rig.lens(eye)
    directions, lux = star_catalogue()
    in_left = np.einsum("ni,ij->nj", directions, rotation)
    if lens is None:
        widest = np.hypot(camera.width_px / camera.fx_px, camera.height_px / camera.fy_px)
        ahead = in_left[:, 2] * widest > np.hypot(in_left[:, 0], in_left[:, 1])
    else:
        ahead = in_left[:, 2] > 0
        ahead[ahead] = lens.is_in_field(in_left[ahead])
    ahead &= directions[:, 2] > _LOWEST_SINE
    rays, lux, up = in_left[ahead], lux[ahead], directions[ahead, 2]
    if len(rays) == 0:
        return
    lux = lux * 10.0 ** (-0.4 * EXTINCTION_MAG * (1.0 / up - 1.0))
    # Illuminance over the solid angle of the pixel.
    level = lux * camera.fx_px * camera.fy_px / rays[:, 2] ** 3 if lens is None else lux * lens.pixels_per_sr(rays)
    center = rig.image(rays * _FAR_M, eye)
    corner = np.floor(center).astype(int)
    share = center - corner
    for du in (0, 1):
        for dv in (0, 1):
            weight = np.abs(1 - du - share[:, 0]) * np.abs(1 - dv - share[:, 1])
            u, v = corner[:, 0] + du, corner[:, 1] + dv
            inside = (u >= 0) & (u < sky.shape[1]) & (v >= 0) & (v < sky.shape[0])
            np.add.at(sky, (v[inside], u[inside]), (level * weight)[inside, None].astype(np.float32))
