"""The lens: point spread, defocus, vignetting and sun glare, between perfectly seen radiance and the sensor's sites."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec, Optics
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from geometry.stereo import Eye
from render.background import background, lens_rays
from render.camera.video_lens import add_bloom, ghosts, see_through, shift_colors
from render.engine import EyeRadiance
from scenes.environment_radiance import environment_radiance
from scenes.sky.photometry import SUN_RADIUS_RAD

# Polished and coated glass scatters 1 / (a^2 + theta^2) around a source (the ABg law of optical
# design with g = 2); the core is our choice for a lens of several elements.
_CORE_RAD = 0.01
_WIDEST_RAD = np.pi / 2
# A hood shades the front lens from a sun this far off the axis: completely beyond the second angle.
_HOOD_BEGINS_RAD, _HOOD_ENDS_RAD = np.radians(25.0), np.radians(45.0)
# By less, a clean lens's veil is at its brightest a tenth of the light of the night sky.
_DARKEST_LUX = 1e-5
# Beyond four sigma the Gaussian holds less than 1e-4 of the light.
_KERNEL_REACH_SIGMA = 4.0
# A smaller blur circle adds less than a 500th to the variance of a pixel's own box.
_SHARP_BELOW_PX = 0.05
_MOST_DEFOCUS_PX = 200.0
_CHORDS_PER_PX = 64
# Lamps are up to so many times brighter than what saturates the sensor; the sun's disc is far beyond, and its glare is
# drawn by itself.
_BRIGHTEST_BLOOM = 300.0


def light_on_sensor(frame: FrameSpec, seen: EyeRadiance, eye: Eye) -> NDArray[np.float32]:
    """(H, W, 3) light on one eye's sensor: defocused, blurred by the point spread, with glare and vignetting.

    Returns:
        In units of scene radiance on the axis. [cd/m2]
    """
    camera = frame.camera
    image = _defocused(frame, seen, eye)
    sun = _sun_on_lens(frame, seen, eye)
    brightest_cd_m2 = _BRIGHTEST_BLOOM * saturation_cd_m2(frame)
    if camera is not None and camera.window is not None:
        image = see_through(image, camera.window, eye, brightest_cd_m2, np.zeros(3) if sun is None else sun[1])
    image = blur(image, frame.sensor.psf_sigma_px)
    lens = frame.rig.lens(eye)
    eye_camera = frame.rig.camera if lens is None else lens.camera
    if camera is not None and (camera.lens.lateral_red_px or camera.lens.lateral_blue_px):
        image = shift_colors(image, camera.lens, eye_camera)
    if camera is not None and camera.lens.bloom_fraction > 0:
        image = add_bloom(image, camera.lens.bloom_fraction, brightest_cd_m2)
    if sun is not None:
        image = cv2.add(image, _sun_glare(frame, eye, *sun))
        if camera is not None and camera.lens.ghost_fraction > 0:
            image = cv2.add(image, ghosts(camera.lens, eye_camera, *sun))
    optics = frame.sensor.optics
    if optics.natural_vignetting or optics.mechanical_falloff_fraction > 0:
        share = transmission(eye_camera, optics, lens)
        # OpenCV takes a third of the time of numpy's product with one channel.
        shaded: NDArray[np.float32] = cv2.multiply(image, cv2.merge([share, share, share]))
        return shaded
    return image


def saturation_cd_m2(frame: FrameSpec) -> float:
    """Luminance on the axis that gives the highest number. [cd/m2]"""
    sensor, exposure = frame.sensor, frame.exposure
    return sensor.full_well_e / max(exposure.gain, 1.0) / sensor.electrons_per_cd_m2(exposure)


def blur(radiance: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """Gaussian point spread of lens and pixel crosstalk.

    Args:
        radiance: (H, W, C), box-sampled.
        sigma_px: standard deviation. [px]
    """
    if sigma_px == 0:
        return radiance
    reach = int(np.ceil(_KERNEL_REACH_SIGMA * sigma_px))
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma_px, cv2.CV_32F)
    blurred: NDArray[np.float32] = cv2.sepFilter2D(
        radiance, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE
    )
    return blurred


@lru_cache(maxsize=4)
def transmission(camera: PinholeCamera, optics: Optics, lens: Lens | None = None) -> NDArray[np.float32]:
    """(H, W) illuminance of each pixel relative to the axis.

    Source: illuminance falls with cos^4 of the angle from the axis (natural vignetting, EMVA Standard 1288); the
    mechanical falloff is our model, `1 - a rho^4`, with rho the distance from the principal point over that of the
    farthest corner.

    Args:
        camera: of the eye.
        optics: which of the two, and how much.
        lens: of the eye, whose distortion moves pixels from their rays; None for an ideal one.
    """
    u = np.arange(camera.width_px) - camera.cx_px
    v = np.arange(camera.height_px) - camera.cy_px
    square_px = u**2 + v[:, None] ** 2
    share = 1.0 - optics.mechanical_falloff_fraction * (square_px / square_px.max()) ** 2
    if optics.natural_vignetting:
        if lens is None:
            share /= (1.0 + (u / camera.fx_px) ** 2 + (v[:, None] / camera.fy_px) ** 2) ** 2
        else:
            share *= (lens_rays(lens, 1) @ lens.ideal_from_real[:, 2]) ** 4
    result: NDArray[np.float32] = share.astype(np.float32)
    return result


def blur_circle_px(frame: FrameSpec, depth_m: float) -> float:
    """Diameter of the blur circle of points at a planar depth, inf for the sky. [px]

    Source: thin lens of aperture D focused on depth s, sensor at image distance v: points at z meet at v' with
    1/v' = 1/v + 1/s - 1/z, and their cone is D |1 - v/v'| = D v |1/s - 1/z| wide on the sensor.
    """
    optics, camera = frame.sensor.optics, frame.rig.camera
    if optics.focus_distance_m is None:
        return 0.0
    focal_m = camera.fx_px * optics.pixel_pitch_um * 1e-6
    aperture_m = focal_m / frame.exposure.f_number
    return aperture_m * camera.fx_px * abs(1.0 / optics.focus_distance_m - 1.0 / depth_m)


def _defocused(frame: FrameSpec, seen: EyeRadiance, eye: Eye) -> NDArray[np.float32]:
    """(H, W, 3) radiance with two layers out of focus: all parts at the depth of the rim's centre, and the far sky.

    A calibration board takes the depth of its own centre. The sky shows where a blurred part no longer covers it:
    `sky (1 - coverage) + parts`, each blurred by its own circle.
    """
    sky_px = blur_circle_px(frame, np.inf)
    pose = frame.board.left_from_board if frame.board is not None else frame.left_from_drogue
    part_px = sky_px if pose is None else blur_circle_px(frame, float(pose.translation_m[2]))
    if max(sky_px, part_px) < _SHARP_BELOW_PX:
        return seen.radiance_cd_m2
    if max(sky_px, part_px) > _MOST_DEFOCUS_PX:
        raise ValueError(
            f"focus_distance_m: gives a blur circle of {max(sky_px, part_px):.0f} px, more than "
            f"{_MOST_DEFOCUS_PX:.0f}; focus farther away, or close the aperture"
        )
    if pose is None:
        return _disc_blur(seen.radiance_cd_m2, sky_px)
    behind = background(frame, eye)
    open_share = 1.0 - seen.coverage[..., None]
    parts = np.where(open_share < 1.0, seen.radiance_cd_m2 - open_share * behind, np.float32(0.0))
    covered = _disc_blur(seen.coverage, part_px)[..., None]
    result: NDArray[np.float32] = _disc_blur(behind, sky_px) * (1.0 - covered) + _disc_blur(parts, part_px)
    return result


def _disc_blur(image: NDArray[np.float32], diameter_px: float) -> NDArray[np.float32]:
    if diameter_px < _SHARP_BELOW_PX:
        return image
    blurred: NDArray[np.float32] = cv2.filter2D(
        image, cv2.CV_32F, disc_kernel(diameter_px).astype(np.float32), borderType=cv2.BORDER_REPLICATE
    )
    return blurred


@lru_cache(maxsize=8)
def disc_kernel(diameter_px: float) -> Array:
    """(2 k + 1, 2 k + 1) weights of a uniform disc on box-sampled pixels.

    Pixels spread the disc by their own box. So a smaller disc is sampled, whose weights have the variance of the true
    disc, a sixteenth of its diameter squared; small circles then blur by the right amount.
    """
    wanted = diameter_px**2 / 16.0
    low, high = 0.0, diameter_px + 2.0
    for _ in range(40):
        middle = (low + high) / 2
        weights = _covered_by_disc(middle)
        low, high = (middle, high) if _variance(weights) < wanted else (low, middle)
    weights = _covered_by_disc(high)
    weights.flags.writeable = False
    return weights


def _covered_by_disc(diameter_px: float) -> Array:
    """Share of a centred disc that falls into each pixel, integrated by its chords."""
    reach = int(np.ceil(diameter_px / 2 - 0.5)) if diameter_px > 1 else 0
    chords = (2 * reach + 1) * _CHORDS_PER_PX
    y = (np.arange(chords) + 0.5) / _CHORDS_PER_PX - reach - 0.5
    half = np.sqrt(np.maximum(diameter_px**2 / 4 - y**2, 0.0))[:, None]
    x = np.arange(-reach, reach + 1)
    length = np.maximum(np.minimum(half, x + 0.5) - np.maximum(-half, x - 0.5), 0.0)
    weights: Array = length.reshape(2 * reach + 1, _CHORDS_PER_PX, 2 * reach + 1).sum(axis=1)
    weights = (weights + weights.T) / 2
    total = weights.sum()
    return weights / total if total > 0 else np.ones((1, 1))


def _variance(weights: Array) -> float:
    """Variance of a centred kernel along one axis. [px^2]"""
    reach = weights.shape[0] // 2
    return float(weights.sum(axis=0) @ np.arange(-reach, reach + 1) ** 2)


def glare_spread_per_sr(angle_rad: NDArray[np.float32], scattered_fraction: float) -> NDArray[np.float32]:
    """Veiling luminance per illuminance of the lens, by the angle from the source. [1/sr]

    Its integral over the hemisphere in front of the lens, for small angles, is the scattered fraction.
    """
    inside = np.log1p((_WIDEST_RAD / _CORE_RAD) ** 2)
    level = scattered_fraction / (np.pi * inside)
    spread: NDArray[np.float32] = (level / (np.float32(_CORE_RAD**2) + angle_rad * angle_rad)).astype(np.float32)
    return spread


def sun_glare(frame: FrameSpec, seen: EyeRadiance, eye: Eye) -> NDArray[np.float32] | None:
    """(H, W, 3) veiling glare of an eye by sun or moon in or near its view, or None without any. [cd/m2]

    Parts in front of the disc reduce the glare.

    Args:
        frame: gives sun, camera and attitude at mid-exposure.
        seen: its coverage tells what hides the sun.
        eye: which eye.
    """
    sun = _sun_on_lens(frame, seen, eye)
    return None if sun is None else _sun_glare(frame, eye, *sun)


def _sun_on_lens(frame: FrameSpec, seen: EyeRadiance, eye: Eye) -> tuple[Array, Array] | None:
    """(3,) direction of sun or moon in the eye's axes, and (3,) illuminance of the lens by it [lux]; None without."""
    ambient = environment_radiance(frame.environment)
    illuminance_lux = ambient.beam_illuminance_lux
    to_sun = frame.world_from_left.inverse().rotate(ambient.beam_direction)
    off_axis = float(np.arccos(np.clip(to_sun[2], -1.0, 1.0)))
    if off_axis >= _HOOD_ENDS_RAD or illuminance_lux.max() < _DARKEST_LUX:
        return None
    shade = np.clip((_HOOD_ENDS_RAD - off_axis) / (_HOOD_ENDS_RAD - _HOOD_BEGINS_RAD), 0.0, 1.0)
    falling = illuminance_lux * to_sun[2] * shade * _open_share(frame, seen, eye, to_sun)
    if falling.max() < _DARKEST_LUX:
        return None
    return to_sun, falling


def _sun_glare(frame: FrameSpec, eye: Eye, to_sun: Array, falling: Array) -> NDArray[np.float32]:
    camera, lens, sun = frame.rig.camera, frame.rig.lens(eye), to_sun.astype(np.float32)
    if lens is None:
        x = ((np.arange(camera.width_px) - camera.cx_px) / camera.fx_px).astype(np.float32)
        y = ((np.arange(camera.height_px) - camera.cy_px) / camera.fy_px).astype(np.float32)[:, None]
        cosine = (x * sun[0] + y * sun[1] + sun[2]) / np.sqrt(1.0 + x * x + y * y)
    else:
        cosine = lens_rays(lens, 1) @ sun
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    spread = glare_spread_per_sr(angle, frame.sensor.optics.scattered_fraction)
    veil: NDArray[np.float32] = spread[..., None] * falling.astype(np.float32)
    return veil


def _open_share(frame: FrameSpec, seen: EyeRadiance, eye: Eye, to_sun: NDArray[np.float64]) -> float:
    """Visible share of the disc; 1 for a sun outside the image."""
    camera = frame.rig.camera
    ideal = camera.project(to_sun)
    if not frame.rig.is_in_field(ideal, eye):
        return 1.0
    center = frame.rig.real_px(ideal, eye)
    if not camera.contains(center):
        return 1.0
    radius_px = SUN_RADIUS_RAD * camera.fx_px
    low = np.maximum(np.floor(center - radius_px), 0).astype(int)
    high = np.ceil(center + radius_px).astype(int) + 1
    covered = seen.coverage[low[1] : high[1], low[0] : high[0]]
    return 1.0 - float(covered.mean())
