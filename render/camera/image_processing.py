"""A camera's image processor: from the raw numbers of a sensor to a picture of 8 bits for screens."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec, Sensor
from datasets_manifest.types.images import srgb_from_light
from datasets_manifest.types.video_camera import ImageProcessing
from geometry.compiled_loops import compiled

Plane = NDArray[np.float32]
_LEVELS = 256
# Noise at the mean level that doubles the widths of denoising [of 255 levels], and the most by which they grow.
_NOISE_DOUBLING, _MOST_WIDENING = 8.0, 2.5
# Colours are made stronger, but not those that are strong; those of highlights fade by up to a half.
_HIGHLIGHT_LEVEL, _FADING = 165.0, 0.5
# Cameras know the colours that daylight and lamps have, and correct no others.
_MOST_GAIN = 1.6


def develop(raw: NDArray[np.uint16], frame: FrameSpec, processing: ImageProcessing) -> NDArray[np.uint8]:
    """A picture of raw numbers.

    Tones and white balance come first, then denoising and sharpening of luma and a blur of chroma, as in Rec. 601.

    Args:
        raw: (H, W) of an RGGB mosaic, or of a monochrome camera.
        frame: gives sensor, exposure and camera.
        processing: as named.

    Returns:
        (H, W, 3), or (H, W) of a monochrome camera.
    """
    tables = tone_tables(processing, frame.sensor.adc_bits, frame.sensor.black_level_dn)
    detail = np.array([processing.kept_detail_fraction, 1.0 + processing.sharpen], dtype=np.float32)
    noise = noise_by_level(frame, processing)
    faint: Plane = np.square(np.maximum(processing.denoise_threshold * noise, 1e-3), dtype=np.float32)
    # The darker it was, the wider processors average.
    levels = tables[1][raw]
    wider = 1.0 + min(float(noise[round(float(levels.mean()))]) / _NOISE_DOUBLING, _MOST_WIDENING)
    if frame.is_monochrome:
        luma = levels
        grey = np.empty(raw.shape, np.uint8)
        _finish_grey(luma, _blurred(luma, wider * processing.denoise_sigma_px), detail, faint, grey)
        return grey
    code = cv2.COLOR_BayerRGGB2RGB_EA if processing.demosaic == "edge-aware" else cv2.COLOR_BayerRGGB2RGB
    linear = cv2.cvtColor(raw, code)
    luma, blue, red = (np.empty(raw.shape, np.float32) for _ in range(3))
    _split(linear, tables, np.float32(processing.saturation), luma, blue, red)
    picture = np.empty(linear.shape, np.uint8)
    blue, red = (_blurred_chroma(plane, wider * processing.chroma_blur_px) for plane in (blue, red))
    _finish(luma, _blurred(luma, wider * processing.denoise_sigma_px), blue, red, detail, faint, picture)
    return picture


def metered(processing: ImageProcessing, frame: FrameSpec, raw: Sequence[NDArray[np.uint16]]) -> ImageProcessing:
    """The processing of a pair: whiter light where the view has a colour, less exposure where it is too bright.

    Args:
        processing: of the scene.
        frame: gives the sensor.
        raw: numbers of both eyes, (H, W) each.
    """
    black, top = frame.sensor.black_level_dn, 2**frame.sensor.adc_bits - 1
    # By rows and columns of the mosaic: red, two greens, blue.
    sites = np.array([[numbers[row::2, column::2].mean() for numbers in raw] for row in (0, 1) for column in (0, 1)])
    red, green_1, green_2, blue = np.maximum((sites.mean(axis=1) - black) / (top - black), 1e-6)
    green, mean = (green_1 + green_2) / 2.0, float(np.mean([red, green_1, green_2, blue]))
    changes: dict[str, object] = {}
    if processing.neutral_fraction > 0 and not frame.is_monochrome:
        toward_grey = np.array([green / red, green / blue]) ** processing.neutral_fraction
        gains = np.clip(toward_grey, 1.0 / _MOST_GAIN, _MOST_GAIN) * processing.white_balance
        changes["white_balance"] = (float(gains[0]), float(gains[1]))
    limit, factor = processing.brightest_mean_fraction, processing.exposure_factor
    if limit < 1.0 and factor * mean / (1.0 + (factor - 1.0) * mean) > limit:
        # Below a twentieth nothing would be left of a picture that is white all over.
        changes["exposure_factor"] = max(limit * (1.0 - mean) / (mean * (1.0 - limit)), 0.06)
    return processing.model_copy(update=changes)


def noise_by_level(frame: FrameSpec, processing: ImageProcessing) -> Plane:
    """(256,) standard deviation of shot and read noise at each level, before denoising. [of 255 levels]"""
    sensor = frame.sensor
    table = tone_tables(processing, sensor.adc_bits, sensor.black_level_dn)[1]
    numbers = np.arange(len(table))
    dn_per_e = (len(table) - 1 - sensor.black_level_dn) * frame.exposure.gain / sensor.full_well_e
    # The table is flat where it is clipped: the first number of a level is the one that has it.
    levels, first = np.unique(table, return_index=True)
    number = np.interp(np.arange(_LEVELS), levels, first)
    electrons = np.maximum(number - sensor.black_level_dn, 0.0) / dn_per_e
    noise_dn = dn_per_e * np.sqrt(electrons + sensor.read_noise_e**2)
    low, high = (np.interp(number + side * noise_dn, numbers, table) for side in (-1, 1))
    noise: Plane = ((high - low) / 2.0).astype(np.float32)
    return noise


@lru_cache(maxsize=8)
def tone_tables(processing: ImageProcessing, adc_bits: int, black_level_dn: int) -> Plane:
    """(3, 2^bits) level of 255 in red, green and blue by raw number.

    The signal x becomes f x / (1 + (f - 1) x): slope f at black, and white stays white. Then come the sRGB curve
    (IEC 61966-2-1), a share of the smoothstep 3 y^2 - 2 y^3 as contrast, and the level of black.
    """
    red, blue = processing.white_balance
    gains = np.array([red, 1.0, blue])
    # The least gain is 1: a clipped highlight stays white.
    gains = gains[:, None] / gains.min()
    number = np.arange(2**adc_bits, dtype=np.float64)
    signal = np.clip(gains * (number - black_level_dn) / (2**adc_bits - 1 - black_level_dn), 0.0, 1.0)
    factor = processing.exposure_factor
    level = srgb_from_light(factor * signal / (1.0 + (factor - 1.0) * signal))
    level += processing.contrast * (level * level * (3.0 - 2.0 * level) - level)
    level = processing.black_fraction + (1.0 - processing.black_fraction) * level
    tables: Plane = ((_LEVELS - 1) * np.clip(level, 0.0, 1.0)).astype(np.float32)
    tables.flags.writeable = False
    return tables


def developed_black_dn(sensor: Sensor, processing: ImageProcessing) -> float:
    """Level of pixels without light in the pictures of `develop`, rounded as there. [DN]"""
    black = tone_tables(processing, sensor.adc_bits, sensor.black_level_dn)[1, sensor.black_level_dn]
    return float(np.floor(black + np.float32(0.5)))


def _blurred(plane: Plane, sigma_px: float) -> Plane:
    result: Plane = cv2.GaussianBlur(plane, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT_101)
    return result


def _blurred_chroma(plane: Plane, sigma_px: float) -> Plane:
    """Chroma at half the resolution, blurred, and enlarged again, corner to corner."""
    height, width = plane.shape
    half = cv2.resize(plane, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA)
    if sigma_px > 0:
        half = cv2.GaussianBlur(half, (0, 0), sigma_px / 2.0, borderType=cv2.BORDER_REFLECT_101)
    result: Plane = cv2.resize(half, (width, height), interpolation=cv2.INTER_LINEAR)
    return result


@compiled
def _split(
    linear: NDArray[np.uint16], tables: Plane, saturation: np.float32, luma: Plane, blue: Plane, red: Plane
) -> None:
    """Fill in luma and the differences B - Y and R - Y of a picture of raw numbers."""
    height, width = luma.shape
    for row in range(height):
        for column in range(width):
            r = tables[0, linear[row, column, 0]]
            g = tables[1, linear[row, column, 1]]
            b = tables[2, linear[row, column, 2]]
            y = np.float32(0.299) * r + np.float32(0.587) * g + np.float32(0.114) * b
            strong = max(abs(b - y), abs(r - y)) / np.float32(_LEVELS)
            bright = max(y - np.float32(_HIGHLIGHT_LEVEL), np.float32(0.0)) / np.float32(255.0 - _HIGHLIGHT_LEVEL)
            # Only more saturation spares strong colours: less of it ends at grey.
            spared = strong if saturation > np.float32(1.0) else np.float32(0.0)
            amount = np.float32(1.0) + (saturation - np.float32(1.0)) * (np.float32(1.0) - spared)
            amount *= np.float32(1.0) - np.float32(_FADING) * bright * bright
            luma[row, column] = y
            blue[row, column] = amount * (b - y)
            red[row, column] = amount * (r - y)


@compiled
def _clean(level: np.float32, smooth: np.float32, detail: Plane, faint: Plane) -> np.float32:
    """Luma with faint detail reduced and distinct detail amplified; `faint` is the square of their border, by level."""
    kept, sharp = detail
    fine = level - smooth
    border = faint[min(max(int(smooth), 0), faint.size - 1)]
    share = fine * fine / (fine * fine + border)
    return np.float32(smooth + fine * (kept + (sharp - kept) * share))


@compiled
def _finish(
    luma: Plane, smooth: Plane, blue: Plane, red: Plane, detail: Plane, faint: Plane, picture: NDArray[np.uint8]
) -> None:
    """Fill in the picture."""
    height, width = luma.shape
    low, top, half = np.float32(0.0), np.float32(255.0), np.float32(0.5)
    for row in range(height):
        for column in range(width):
            y = _clean(luma[row, column], smooth[row, column], detail, faint)
            r, b = y + red[row, column], y + blue[row, column]
            # Rec. 601: Y = 0.299 R + 0.587 G + 0.114 B.
            g = y - np.float32(0.299 / 0.587) * red[row, column] - np.float32(0.114 / 0.587) * blue[row, column]
            picture[row, column, 0] = np.uint8(min(max(r, low), top) + half)
            picture[row, column, 1] = np.uint8(min(max(g, low), top) + half)
            picture[row, column, 2] = np.uint8(min(max(b, low), top) + half)


@compiled
def _finish_grey(luma: Plane, smooth: Plane, detail: Plane, faint: Plane, picture: NDArray[np.uint8]) -> None:
    """Fill in a monochrome picture."""
    height, width = luma.shape
    low, top, half = np.float32(0.0), np.float32(255.0), np.float32(0.5)
    for row in range(height):
        for column in range(width):
            y = _clean(luma[row, column], smooth[row, column], detail, faint)
            picture[row, column] = np.uint8(min(max(y, low), top) + half)
