"""The sensor: illuminance becomes electrons, noise and digital numbers.

Electrons = responsivity x illuminance x time. Then come the gain of each pixel, shot and read noise, full well, the
analogue-to-digital converter, the mosaic and the encoding. In low light shot noise is a true Poisson draw; above some
dozens of electrons it is a normal draw of the same variance.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import bulk_frame_generator
from datasets_manifest.types.frame import FrameSpec, Sensor
from datasets_manifest.types.images import Pixels, StereoImages, srgb_from_light
from datasets_manifest.types.video_camera import ImageProcessing
from geometry.stereo import EYES, Eye
from render.camera.image_coding import deliver
from render.camera.image_processing import develop, developed_black_dn, metered
from render.camera.optics import light_on_sensor
from render.camera.sensor_readout import SensorReadout
from render.engine import StereoRadiance
from scenes.sky.photometry import infrared_light, infrared_weights

# Response of bare silicon behind a daylight scene to the three bands of Rec. 709 (our assumption).
MONO_WEIGHTS = np.array([[0.36, 0.37, 0.27]], dtype=np.float32)
# Sites of the RGGB mosaic: channel, first row, first column.
_MOSAIC_SITES = ((0, 0, 0), (1, 0, 1), (1, 1, 0), (2, 1, 1))


def dn_per_electron(sensor: Sensor, gain: float) -> float:
    """Digital numbers per electron; at gain 1 a full well gives the highest number. [DN/e-]"""
    return float(gain * (2**sensor.adc_bits - 1 - sensor.black_level_dn) / sensor.full_well_e)


def expose(frame: FrameSpec, radiance: StereoRadiance) -> StereoImages:
    """The stereo pair of images that the sensors deliver.

    Args:
        frame: gives sensor, exposure and the keys of the random streams.
        radiance: of both eyes.
    """
    sensor = frame.sensor
    images: dict[Eye, Pixels] = {}
    mosaics: dict[Eye, Pixels | None] = {}
    readout = SensorReadout(
        electrons_per_cd_m2=sensor.electrons_per_cd_m2(frame.exposure),
        read_noise_e=sensor.read_noise_e,
        full_well_e=sensor.full_well_e,
        dn_per_e=dn_per_electron(sensor, frame.exposure.gain),
        black_level_dn=sensor.black_level_dn,
        adc_bits=sensor.adc_bits,
        is_noise_free=sensor.noise_free,
    )
    numbers: dict[Eye, NDArray[np.uint16]] = {}
    for index, eye in enumerate(EYES):
        seen = light_on_sensor(frame, radiance.left if eye == "left" else radiance.right, eye)
        light = _sample_sites(seen, frame)
        gains = _pixel_gains(frame.seed, index, light.shape, 0.0 if sensor.noise_free else sensor.prnu_fraction)
        rng = bulk_frame_generator(frame.seed, frame.frame_index, f"sensor noise {eye}")
        numbers[eye] = readout.digital_numbers(light, gains, rng)
        mosaics[eye] = _store(numbers[eye], sensor, "linear") if sensor.color == "bayer" else None
    processing = None if frame.camera is None else frame.camera.processing
    if processing is not None:
        processing = metered(processing, frame, list(numbers.values()))
    for eye in EYES:
        images[eye] = _picture(numbers[eye], frame, processing)
    if processing is not None:
        black_level_dn = developed_black_dn(sensor, processing)
    else:
        black = np.array([[sensor.black_level_dn]], dtype=np.uint16)
        black_level_dn = float(_store(black, sensor, sensor.encoding)[0, 0])
    return StereoImages(
        left=images["left"],
        right=images["right"],
        time_s=frame.time_s,
        exposure_s=frame.exposure.time_s,
        bits=sensor.output_bits,
        encoding=sensor.encoding,
        black_level_dn=black_level_dn,
        left_mosaic=mosaics["left"],
        right_mosaic=mosaics["right"],
    )


def _picture(numbers: NDArray[np.uint16], frame: FrameSpec, processing: ImageProcessing | None) -> Pixels:
    """The image of an eye as it is stored: (H, W, 3), or (H, W) of a monochrome sensor."""
    sensor, camera = frame.sensor, frame.camera
    if processing is not None:
        picture: Pixels = develop(numbers, frame, processing)
    else:
        if sensor.color == "bayer" and not frame.is_monochrome:
            numbers = cv2.cvtColor(numbers, cv2.COLOR_BayerRGGB2RGB)
        picture = _store(numbers, sensor, sensor.encoding)
    if camera is None:
        return picture
    delivered: Pixels = deliver(picture.astype(np.uint8, copy=False), frame, camera)
    # A monochrome camera in a dataset with colour ones.
    is_colour_file = sensor.color != "mono" and delivered.ndim == 2
    return cv2.cvtColor(delivered, cv2.COLOR_GRAY2RGB) if is_colour_file else delivered


def _sample_sites(seen: NDArray[np.float32], frame: FrameSpec) -> NDArray[np.float32]:
    """Light on each site of the sensor: (H, W, 3), or (H, W) for a mosaic or a monochrome sensor."""
    camera, color = frame.camera, frame.sensor.color
    if frame.is_monochrome:
        return monochrome_light(seen, frame.band_nm)
    if color == "rgb" and (camera is None or camera.processing is None):
        return seen
    mosaic = np.empty(seen.shape[:2], dtype=np.float32)
    for channel, row, column in _MOSAIC_SITES:
        mosaic[row::2, column::2] = seen[row::2, column::2, channel]
    return mosaic


def monochrome_light(light: NDArray[np.float32], band_nm: float | None) -> NDArray[np.float32]:
    """(H, W) light that a monochrome sensor collects of (H, W, 3) light; `band_nm` as of frames. [cd/m2]"""
    if band_nm is not None:
        return infrared_light(light, band_nm)
    mono: NDArray[np.float32] = cv2.transform(light, MONO_WEIGHTS)
    return mono


def mono_weights(band_nm: float | None) -> NDArray[np.float64]:
    """(1, 3) weights of the three bands in a monochrome sensor, without what plants have beyond red."""
    return MONO_WEIGHTS.astype(np.float64) if band_nm is None else infrared_weights(band_nm)[None]


@lru_cache(maxsize=2)
def _pixel_gains(seed: int, eye_index: int, shape: tuple[int, ...], spread: float) -> NDArray[np.float32]:
    """Fixed gain of every site of one sensor, mean 1."""
    rng = bulk_frame_generator(seed, eye_index, "pixel gains")
    gains = rng.standard_normal(shape, dtype=np.float32)
    gains *= np.float32(spread)
    gains += np.float32(1.0)
    return gains


def _store(numbers: NDArray[np.uint16], sensor: Sensor, encoding: str) -> Pixels:
    """Digital numbers as stored: linear or on the sRGB curve, in `output_bits`."""
    if encoding == "linear":
        if sensor.output_bits == sensor.adc_bits:
            return numbers
        # Scales, rounds half to even and clips in one pass; a lookup table takes three times as long.
        scaled: Pixels = cv2.convertScaleAbs(numbers, alpha=2**sensor.output_bits / 2**sensor.adc_bits)
        return scaled
    table = _gamma_table(sensor.adc_bits, sensor.output_bits, sensor.black_level_dn)
    stored: Pixels = table[numbers]
    return stored


@lru_cache(maxsize=8)
def _gamma_table(adc_bits: int, output_bits: int, black_level_dn: int) -> Pixels:
    """Stored number for every digital number, on the sRGB curve.

    Source of the curve: IEC 61966-2-1 (sRGB), on the signal above the black level.
    """
    numbers = np.arange(2**adc_bits, dtype=np.float64)
    signal = np.clip((numbers - black_level_dn) / (2**adc_bits - 1 - black_level_dn), 0.0, 1.0)
    table: Pixels = np.rint(srgb_from_light(signal) * (2**output_bits - 1)).astype(
        np.uint8 if output_bits == 8 else np.uint16
    )
    return table
