"""The sensor: illuminance becomes electrons, noise, numbers.

Electrons = responsivity x illuminance x time; gain of each pixel; shot and read noise, full well and converter
(`render/camera/readout.py`); mosaic and encoding.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import bulk_frame_generator
from datasets_manifest.types.frame import FrameSpec, Sensor
from datasets_manifest.types.images import Pixels, StereoImages
from geometry.stereo import EYES, Eye
from render.camera.optics import light_on_sensor
from render.camera.readout import ReadOut
from render.engine import StereoRadiance

# Response of bare silicon behind a daylight scene to the three bands of Rec. 709 (our assumption).
MONO_WEIGHTS = np.array([[0.36, 0.37, 0.27]], dtype=np.float32)
# Sites of the RGGB mosaic: channel, first row, first column.
_MOSAIC_SITES = ((0, 0, 0), (1, 0, 1), (1, 1, 0), (2, 1, 1))


def dn_per_electron(sensor: Sensor, gain: float) -> float:
    """Numbers of the converter per electron; at gain 1 a full well is the highest number. [DN/e-]"""
    return float(gain * (2**sensor.adc_bits - 1 - sensor.black_level_dn) / sensor.full_well_e)


def expose(frame: FrameSpec, radiance: StereoRadiance) -> StereoImages:
    """The stereo pair of images that the sensors deliver.

    Args:
        frame: names sensor, exposure and the random streams.
        radiance: absolute radiance of both eyes.
    """
    sensor = frame.sensor
    images: dict[Eye, Pixels] = {}
    mosaics: dict[Eye, Pixels | None] = {}
    read_out = ReadOut(
        sensor.electrons_per_cd_m2(frame.exposure),
        sensor.read_noise_e,
        sensor.full_well_e,
        dn_per_electron(sensor, frame.exposure.gain),
        sensor.black_level_dn,
        sensor.adc_bits,
    )
    for index, eye in enumerate(EYES):
        seen = light_on_sensor(frame, radiance.left if eye == "left" else radiance.right, eye)
        light = _sample_sites(seen, sensor)
        gains = _pixel_gains(frame.seed, index, light.shape, sensor.prnu_fraction)
        rng = bulk_frame_generator(frame.seed, frame.frame_index, f"sensor noise {eye}")
        numbers = read_out.numbers(light, gains, rng)
        mosaics[eye] = _store(numbers, sensor, "linear") if sensor.color == "bayer" else None
        if sensor.color == "bayer":
            numbers = cv2.cvtColor(numbers, cv2.COLOR_BayerRGGB2RGB)
        images[eye] = _store(numbers, sensor, sensor.encoding)
    return StereoImages(
        images["left"],
        images["right"],
        frame.time_s,
        frame.exposure.time_s,
        sensor.output_bits,
        sensor.encoding,
        float(_store(np.array([[sensor.black_level_dn]], dtype=np.uint16), sensor, sensor.encoding)[0, 0]),
        mosaics["left"],
        mosaics["right"],
    )


def _sample_sites(seen: NDArray[np.float32], sensor: Sensor) -> NDArray[np.float32]:
    """The light that each of the sensor's sites takes: (H, W, 3), or (H, W) behind a mosaic or no filter."""
    if sensor.color == "rgb":
        return seen
    if sensor.color == "mono":
        mono: NDArray[np.float32] = cv2.transform(seen, MONO_WEIGHTS)
        return mono
    mosaic = np.empty(seen.shape[:2], dtype=np.float32)
    for channel, row, column in _MOSAIC_SITES:
        mosaic[row::2, column::2] = seen[row::2, column::2, channel]
    return mosaic


@lru_cache(maxsize=2)
def _pixel_gains(seed: int, eye_index: int, shape: tuple[int, ...], spread: float) -> NDArray[np.float32]:
    """Fixed gain of every site of one sensor, mean 1."""
    rng = bulk_frame_generator(seed, eye_index, "pixel gains")
    gains = rng.standard_normal(shape, dtype=np.float32)
    gains *= np.float32(spread)
    gains += np.float32(1.0)
    return gains


def _store(numbers: NDArray[np.uint16], sensor: Sensor, encoding: str) -> Pixels:
    """Numbers of the converter as stored: linear or through the sRGB curve, in `output_bits`."""
    if encoding == "linear":
        if sensor.output_bits == sensor.adc_bits:
            return numbers
        # Scales, rounds half to even and clips in one pass; a table of all numbers takes three times as long.
        scaled: Pixels = cv2.convertScaleAbs(numbers, alpha=2**sensor.output_bits / 2**sensor.adc_bits)
        return scaled
    table = _gamma_table(sensor.adc_bits, sensor.output_bits, sensor.black_level_dn)
    stored: Pixels = table[numbers]
    return stored


@lru_cache(maxsize=8)
def _gamma_table(adc_bits: int, output_bits: int, black_level_dn: int) -> Pixels:
    """Stored number for every number of the converter, through the curve.

    Source of the curve: IEC 61966-2-1 (sRGB), on the signal above the black level.
    """
    numbers = np.arange(2**adc_bits, dtype=np.float64)
    signal = np.clip((numbers - black_level_dn) / (2**adc_bits - 1 - black_level_dn), 0.0, 1.0)
    curve = np.where(signal <= 0.0031308, 12.92 * signal, 1.055 * signal ** (1 / 2.4) - 0.055)
    table: Pixels = np.rint(curve * (2**output_bits - 1)).astype(np.uint8 if output_bits == 8 else np.uint16)
    return table
