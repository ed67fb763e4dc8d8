"""Photometric augmentation: exposure, gamma, white balance, colour, blur, noise, low light.

Images are encoded by the sRGB curve whatever the dataset's sensor (`nav.detector.input_image`), and factors multiply
encoded numbers: half the number is about a fifth of the light.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nav.training.image_views import Image

# Shares of the images, and the ranges of what is drawn then.
_TONE_FRACTION, _EXPOSURE, _GAMMA, _BALANCE = 0.8, (0.55, 1.7), (0.7, 1.45), (0.85, 1.18)
_CAST_FRACTION, _CAST = 0.2, (0.6, 1.5)
_GREY_FRACTION = 0.08  # mono cameras; and colour must not be all that the network knows
_SATURATION = (0.5, 1.4)
_LOW_LIGHT_FRACTION, _LOW_LIGHT = 0.12, (0.15, 0.5)
_LEAST_MEAN_DN = 20.0  # no image is made darker: a drogue that nobody sees would keep its box
_BLUR_FRACTION, _BLUR_SIGMA_PX = 0.15, (0.4, 1.6)
_STREAK_FRACTION, _STREAK_PX = 0.08, (3, 9)
_NOISE_FRACTION, _NOISE_DN = 0.35, (0.5, 6.0)
_LOW_LIGHT_NOISE_DN = (2.0, 8.0)


def vary_light(rng: np.random.Generator, image: Image) -> Image:
    """The image in other light, by another camera. (H, W, 3) to a new (H, W, 3)."""
    is_dark = rng.random() < _LOW_LIGHT_FRACTION
    image = cv2.LUT(_mix_colors(rng, image), _tone_curves(rng))
    if is_dark:
        image = _darken(rng, image)
    if rng.random() < _BLUR_FRACTION:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), _log_uniform(rng, _BLUR_SIGMA_PX).item()), dtype=np.uint8)
    if rng.random() < _STREAK_FRACTION:
        image = _streak(rng, image)
    if is_dark or rng.random() < _NOISE_FRACTION:
        image = _add_noise(rng, image, _log_uniform(rng, _LOW_LIGHT_NOISE_DN if is_dark else _NOISE_DN).item())
    return image


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float], count: int = 1) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), count))
    return values


def _mix_colors(rng: np.random.Generator, image: Image) -> Image:
    """Less or more saturated; grey at times."""
    saturation = 0.0 if rng.random() < _GREY_FRACTION else rng.uniform(*_SATURATION)
    if abs(saturation - 1) < 0.1:
        return image
    luminance = np.full((3, 3), (0.2126, 0.7152, 0.0722))  # Rec. 709
    mix = luminance + saturation * (np.eye(3) - luminance)
    return np.asarray(cv2.transform(image, mix), dtype=np.uint8)


def _tone_curves(rng: np.random.Generator) -> NDArray[np.uint8]:
    """(256, 1, 3) new number for every old one and colour."""
    gain, gamma, balance = np.ones(1), np.ones(1), np.ones(3)
    if rng.random() < _TONE_FRACTION:
        gain, gamma = _log_uniform(rng, _EXPOSURE), _log_uniform(rng, _GAMMA)
        balance = _log_uniform(rng, _BALANCE, 3)
    if rng.random() < _CAST_FRACTION:
        balance = balance * _log_uniform(rng, _CAST, 3)
    level = (np.arange(256) / 255)[:, None] ** gamma * gain * balance
    curves: NDArray[np.uint8] = np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)
    return curves[:, None, :]


def _darken(rng: np.random.Generator, image: Image) -> Image:
    """In low light."""
    gain = max(_log_uniform(rng, _LOW_LIGHT).item(), min(1.0, _LEAST_MEAN_DN / max(float(image.mean()), 1.0)))
    return np.asarray(cv2.LUT(image, np.rint(gain * np.arange(256)).astype(np.uint8)), dtype=np.uint8)


def _streak(rng: np.random.Generator, image: Image) -> Image:
    """Motion along a straight line."""
    length_px = int(rng.integers(_STREAK_PX[0], _STREAK_PX[1] + 1))
    kernel = np.zeros((length_px, length_px))
    middle, angle = (length_px - 1) / 2, rng.uniform(0, np.pi)
    for t in np.linspace(-middle, middle, 4 * length_px):
        kernel[round(middle + t * np.sin(angle)), round(middle + t * np.cos(angle))] = 1
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), dtype=np.uint8)


def _add_noise(rng: np.random.Generator, image: Image, sigma_dn: float) -> Image:
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noise *= np.float32(sigma_dn)
    noise += image
    np.rint(noise, out=noise)
    return np.clip(noise, 0, 255, out=noise).astype(np.uint8)
