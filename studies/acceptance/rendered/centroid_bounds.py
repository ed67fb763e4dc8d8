"""The smallest error with which the centre of a disc can be measured, from the light alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from geometry.se3 import Array

# The trapezoidal rule on a smooth closed curve converges faster than any power; so many points per pixel of
# circumference carry it beyond single precision for blurs down to 0.3 px.
_POINTS_PER_PX = 8
# Beyond so many deviations of the blur nothing changes.
_REACH_SIGMA = 6.0


@dataclass(frozen=True)
class PixelLight:
    """What pixels on and beside a disc receive, and the sensor's own noise.

    Attributes:
        background_e, contrast_e: electrons beside the disc, and the disc's above those.
        read_noise_e: [electrons]
        step_e: electrons per number of the stored image; rounding adds a twelfth of its square.
        psf_sigma_px: Gaussian blur after the pixel's box. [px]
        prnu_fraction: standard deviation of the pixels' gains.
    """

    background_e: float
    contrast_e: float
    read_noise_e: float
    step_e: float
    psf_sigma_px: float
    prnu_fraction: float = 0.0


def outline_coverage(outline_px: Array, tangent_px: Array, x_px: Array, y_px: Array, psf_sigma_px: float) -> Array:
    """Share of light from within a smooth outline that each pixel of a grid receives, exact for box and Gaussian blur.

    Args:
        outline_px: (K, 2) points of the closed outline at even steps of its parameter, in the sense from x to y. [px]
        tangent_px: (K, 2) derivatives by the parameter, times its step.
        x_px, y_px: (W,) columns and (H,) rows.
        psf_sigma_px: Gaussian blur after the pixel's box. [px]

    Returns:
        (H, W). Green's theorem: the double integral of the blur over the inside is that of its first integral in x,
        `F(X - x) e(Y - y) dY`, along the outline.
    """
    across = _box_blur_integral(outline_px[:, 0] - x_px[:, None], psf_sigma_px)
    down = _box_blur(outline_px[:, 1] - y_px[:, None], psf_sigma_px) * tangent_px[:, 1]
    coverage: Array = down @ across.T
    return coverage


def disc_outline_px(center_px: Array, radius_px: float) -> tuple[Array, Array]:
    """Points and tangents of a circle for `outline_coverage`."""
    count = int(np.ceil(_POINTS_PER_PX * 2 * np.pi * max(radius_px, 1.0)))
    angle = 2 * np.pi * np.arange(count) / count
    arms = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * radius_px
    tangents = np.stack([-arms[:, 1], arms[:, 0]], axis=-1) * (2 * np.pi / count)
    return center_px + arms, tangents


def center_bound_px(radius_px: float, light: PixelLight, center_px: tuple[float, float] = (0.0, 0.0)) -> float:
    """Cramer-Rao bound of a disc's centre per axis (root mean square of both). [px]

    All but the centre may be unknown, as long as it is even about the centre: such parameters take nothing from it.

    Args:
        radius_px: of the disc's image.
        light: levels and noise.
        center_px: place of the centre against the pixels.
    """
    reach = int(np.ceil(radius_px + _REACH_SIGMA * light.psf_sigma_px + 1.5))
    grid = np.arange(-reach, reach + 1, dtype=np.float64)
    outline, tangent = disc_outline_px(np.asarray(center_px, dtype=np.float64), radius_px)
    coverage = outline_coverage(outline, tangent, grid, grid, light.psf_sigma_px)
    across = _box_blur(outline[:, 0] - grid[:, None], light.psf_sigma_px)
    down = _box_blur(outline[:, 1] - grid[:, None], light.psf_sigma_px)
    by_x, by_y = (down * tangent[:, 1]) @ across.T, -(down * tangent[:, 0]) @ across.T
    signal = light.background_e + light.contrast_e * coverage
    variance = signal + light.read_noise_e**2 + light.step_e**2 / 12 + (light.prnu_fraction * signal) ** 2
    slopes = light.contrast_e * np.stack([by_x, by_y])
    information = np.einsum("iyx,jyx,yx->ij", slopes, slopes, 1 / variance)
    return float(np.sqrt(np.trace(np.linalg.inv(information)) / 2))


def _box_blur(offset_px: Array, sigma_px: float) -> Array:
    """Response of a pixel to a line of light at an offset: box of one pixel and Gaussian. [1/px]"""
    scale = 1 / (np.sqrt(2) * sigma_px)
    blur: Array = (erf((offset_px + 0.5) * scale) - erf((offset_px - 0.5) * scale)) / 2
    return blur


def _box_blur_integral(offset_px: Array, sigma_px: float) -> Array:
    """Integral of `_box_blur` from minus infinity."""

    def twice(u: Array) -> Array:
        # Integral of the normal distribution function: u Phi(u) + sigma^2 phi(u).
        z = u / sigma_px
        value: Array = u * (1 + erf(z / np.sqrt(2))) / 2 + sigma_px * np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
        return value

    integral: Array = twice(offset_px + 0.5) - twice(offset_px - 0.5)
    return integral
