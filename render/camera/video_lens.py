"""Flaws of a drawn camera's lens and of the window before it, in linear light, before the photons are counted."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.video_camera import LensFlaws, Window
from geometry.pinhole import PinholeCamera
from geometry.stereo import EYES, Eye

Light = NDArray[np.float32]

# Bloom and marks on a window are wider than this, so that they are drawn on a coarser grid.
_STEP_PX = 4
# Octaves of the bloom's radius: from a step to the width of the picture.
_BLOOM_LEVELS = 6
_GHOSTS = 6
# Ghosts are images of the aperture. [rad]
_GHOST_RADIUS_RAD = (0.008, 0.07)


def shift_colors(light: Light, flaws: LensFlaws, camera: PinholeCamera) -> Light:
    """Lateral colour: red and blue scaled about the principal point; green stays in place.

    Args:
        light: (H, W, 3).
        flaws: of the lens.
        camera: of the eye.
    """
    center = np.array([camera.cx_px, camera.cy_px])
    size = np.array([camera.width_px, camera.height_px])
    corner_px = float(np.linalg.norm(np.maximum(center, size - 1 - center)))
    shifted = light.copy()
    for channel, shift_px in ((0, flaws.lateral_red_px), (2, flaws.lateral_blue_px)):
        if shift_px:
            scale = 1.0 / (1.0 + shift_px / corner_px)
            source_from_target = np.column_stack([scale * np.eye(2), (1.0 - scale) * center])
            plane = cv2.warpAffine(
                cv2.extractChannel(light, channel),
                source_from_target,
                (camera.width_px, camera.height_px),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_REPLICATE,
            )
            cv2.insertChannel(plane, shifted, channel)
    return shifted


def add_bloom(light: Light, fraction: float, most_cd_m2: float) -> Light:
    """Spread a share of the light of every point over its surroundings.

    Scattering glass spreads light by the inverse square of the angle (the ABg law with g = 2, as in `sun_glare`). That
    is equal shares in every octave of radius: here in Gaussian blurs, each twice as wide as the one before.

    Args:
        light: (H, W, 3). [cd/m2]
        fraction: share that is spread.
        most_cd_m2: light beyond this is left out: the discs of sun and moon, whose glare is drawn by itself.
    """
    height, width = light.shape[:2]
    level = np.minimum(_reduced(light, _STEP_PX), np.float32(most_cd_m2))
    levels = []
    for _ in range(_BLOOM_LEVELS):
        levels.append(cv2.GaussianBlur(level, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE))
        level = _reduced(level, 2)
    spread = levels[-1]
    for finer in reversed(levels[:-1]):
        spread = finer + _enlarged(spread, finer.shape[1], finer.shape[0])
    spread = _enlarged(spread, width, height)
    result: Light = cv2.addWeighted(light, 1.0 - fraction, spread, fraction / _BLOOM_LEVELS, 0.0)
    return result


def ghosts(
    flaws: LensFlaws, camera: PinholeCamera, to_sun: NDArray[np.float64], on_lens_lux: NDArray[np.float64]
) -> Light:
    """(H, W, 3) ghosts of the sun: images of the aperture on the line through the sun and the principal point. [cd/m2]

    Args:
        flaws: of the lens.
        camera: of the eye.
        to_sun: (3,) direction of the sun in the camera's axes, in front of it.
        on_lens_lux: (3,) illuminance of the lens by the sun.
    """
    rng = frame_generator(flaws.ghost_seed, 0, "lens ghosts")
    center = np.array([camera.cx_px, camera.cy_px])
    from_center_px = camera.fx_px * to_sun[:2] / to_sun[2]
    columns, rows = -(-camera.width_px // _STEP_PX), -(-camera.height_px // _STEP_PX)
    u = (np.arange(columns) + 0.5) * _STEP_PX - 0.5
    v = (np.arange(rows) + 0.5)[:, None] * _STEP_PX - 0.5
    layer = np.zeros((rows, columns, 3), dtype=np.float32)
    for _ in range(_GHOSTS):
        along, place, share = rng.uniform(-1.4, 0.7), rng.random(), rng.exponential()
        tint = 0.4 + 0.6 * rng.random(3)
        low_rad, high_rad = _GHOST_RADIUS_RAD
        radius_rad = low_rad * (high_rad / low_rad) ** place
        radius_px = radius_rad * camera.fx_px
        ghost = center + along * from_center_px
        away_px = np.hypot(u - ghost[0], v - ghost[1])
        disc = np.clip((radius_px - away_px) / (0.15 * radius_px + _STEP_PX) + 0.5, 0.0, 1.0)
        if disc.any():
            luminance = flaws.ghost_fraction / _GHOSTS * share * on_lens_lux * tint / (np.pi * radius_rad**2)
            layer += (disc[..., None] * luminance).astype(np.float32)
    return _enlarged(layer, camera.width_px, camera.height_px)


def see_through(light: Light, window: Window, eye: Eye, most_cd_m2: float, sun_lux: NDArray[np.float64]) -> Light:
    """The light behind a window: less of it, and what the window's marks scatter and its surface reflects.

    Both follow the mean of the view and the sun, in whose light a white diffuser has the luminance E / pi.

    Args:
        light: (H, W, 3). [cd/m2]
        window: before the lens.
        eye: which part of it is in the way.
        most_cd_m2: light beyond this is left out of the mean: the sun's disc, which counts by `sun_lux` whether the
            picture holds it or not.
        sun_lux: (3,) illuminance of the window by the sun.
    """
    height, width = light.shape[:2]
    kept, scattered = _window_marks(window, eye, width, height)
    mean = np.array(cv2.mean(_reduced(np.minimum(light, np.float32(most_cd_m2)), 8))[:3])
    luminance = (mean + sun_lux / np.pi).astype(np.float32)
    kept = _enlarged(cv2.merge([kept, kept, kept]), width, height)
    added = _enlarged(scattered[..., None] * luminance, width, height)
    result: Light = cv2.add(cv2.multiply(light, kept), added)
    return result


@lru_cache(maxsize=4)
def _window_marks(window: Window, eye: Eye, width_px: int, height_px: int) -> tuple[Light, Light]:
    """Share of the light that passes, and luminance that is added over that of the surroundings, on a coarse grid.

    A mark a hand's breadth away is blurred over some 20 pixels of the paper's camera.
    """
    rng = frame_generator(window.seed, EYES.index(eye), "window marks")
    columns, rows = -(-width_px // _STEP_PX), -(-height_px // _STEP_PX)
    unit = columns / 320.0
    lost, added = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    if window.dirt_fraction:
        spots = np.zeros_like(lost)
        for _ in range(int(rng.integers(8, 40))):
            _draw_spot(spots, rng, unit * rng.uniform(1.0, 9.0), rng.random())
        lost += window.dirt_fraction * np.minimum(cv2.GaussianBlur(spots, (0, 0), 3.0 * unit), 1.0)
        added += 0.3 * lost
    for _ in range(window.scratches):
        line = np.zeros((rows, columns), np.uint8)
        start = rng.random(2) * (columns, rows)
        end = start + rng.normal(0.0, 0.25 * columns, 2)
        cv2.line(line, _pixel(start), _pixel(end), 255, 1, cv2.LINE_AA)
        blurred = cv2.GaussianBlur(line.astype(np.float32) / 255.0, (0, 0), unit * rng.uniform(0.8, 2.5))
        added += np.float32(rng.uniform(0.05, 0.4)) * blurred
    if window.drops:
        dark, bright = np.zeros_like(lost), np.zeros_like(lost)
        for _ in range(window.drops):
            _draw_drop(dark, bright, rng, unit)
        lost += cv2.GaussianBlur(dark, (0, 0), 1.8 * unit)
        added += cv2.GaussianBlur(bright, (0, 0), 2.0 * unit)
    if window.reflection_fraction:
        shapes = np.zeros_like(lost)
        for _ in range(int(rng.integers(2, 6))):
            corner = rng.random(2) * (columns, rows)
            opposite = corner + rng.uniform(0.1, 0.5, 2) * columns
            cv2.rectangle(shapes, _pixel(corner), _pixel(opposite), float(rng.random()), -1)
        added += window.reflection_fraction * cv2.GaussianBlur(shapes, (0, 0), 10.0 * unit)
    return (1.0 - np.minimum(lost, 0.9)).astype(np.float32), added.astype(np.float32)


def _draw_drop(dark: Light, bright: Light, rng: np.random.Generator, unit: float) -> None:
    """Draw a few drops grown together, dark above and bright below, for they show the view upside down."""
    at = rng.random(2) * (dark.shape[1], dark.shape[0])
    radius = unit * float(np.clip(np.exp(rng.normal(1.1, 0.6)), 1.0, 12.0))
    strength = rng.uniform(0.1, 0.45)
    for part in range(int(rng.integers(1, 4))):
        size = radius * (rng.uniform(0.75, 1.25, 2) if part == 0 else rng.uniform(0.3, 0.8, 2))
        # Drops run down the glass and leave their tails above.
        place = at if part == 0 else at + radius * rng.normal((0.0, -0.4), (0.5, 0.8))
        turn_deg = rng.uniform(-25.0, 25.0)
        for layer, level, down in ((dark, strength, -0.2), (bright, 0.8 * strength, 0.45)):
            center = place + np.array([0.0, down * size[1]])
            axes = np.maximum(np.rint(size * (1.0 if layer is dark else 0.6)), 1.0)
            cv2.ellipse(layer, _pixel(center), _pixel(axes), turn_deg, 0.0, 360.0, level, -1)


def _draw_spot(layer: Light, rng: np.random.Generator, radius: float, level: float) -> NDArray[np.float64]:
    """Draw a filled circle somewhere, and say where."""
    at = rng.random(2) * (layer.shape[1], layer.shape[0])
    cv2.circle(layer, _pixel(at), max(round(radius), 1), float(level), -1)
    return at


def _pixel(place: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _reduced(image: Light, step: int) -> Light:
    """A copy with one pixel for each square of `step` pixels a side."""
    size = -(-image.shape[1] // step), -(-image.shape[0] // step)
    result: Light = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return result


def _enlarged(image: Light, width_px: int, height_px: int) -> Light:
    result: Light = cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
    return result
