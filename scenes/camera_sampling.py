"""Sampling a scene's camera: its sensor and lens, what is before the lens, and what happens to its pictures."""

from __future__ import annotations

import numpy as np

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.recipe.camera_ranges import CameraRanges
from datasets_manifest.recipe.recipe import Recipe
from datasets_manifest.recipe.rigs import SENSORS
from datasets_manifest.types.frame import Sensor
from datasets_manifest.types.video_camera import (
    ImageCoding,
    ImageProcessing,
    LensFlaws,
    Overlay,
    Spectrum,
    VideoCamera,
    Window,
)
from drogue_models.parameters import WHITE_PAINT
from scenes.environment_sampling import sample_uniform

# Of a sensor behind an infrared filter to its band, against that to the visible.
_NEAR_INFRARED_SENSITIVITY = SENSORS["mono-850"].responsivity_e_per_lux_s / SENSORS["mono"].responsivity_e_per_lux_s
# Reflectance that a picture shows as mid-grey (the grey card of photography).
_GREY_CARD = 0.18


def camera_of_scene(recipe: Recipe, scene_id: int) -> tuple[Sensor, VideoCamera | None]:
    """The sensor of a scene and its camera; the recipe's sensor and None in a recipe without `[camera]`."""
    sensor, ranges = recipe.sensor, recipe.camera
    if ranges is None:
        return sensor, None
    # A stream for each part: a new key of one changes none of the others.
    lens_rng, window_rng, processing_rng, coding_rng, overlay_rng = (
        frame_generator(recipe.stream_seed, scene_id, f"camera {part}")
        for part in ("lens", "window", "processing", "coding", "overlay")
    )
    sensor, flaws, spectrum = _sample_lens(lens_rng, ranges, sensor)
    camera = VideoCamera(
        spectrum=spectrum,
        lens=flaws,
        window=_sample_window(window_rng, ranges),
        processing=_sample_processing(processing_rng, ranges, recipe.exposure.auto_level_fraction),
        coding=_sample_coding(coding_rng, ranges),
        overlay=_sample_overlay(overlay_rng, ranges),
    )
    return sensor, camera


def _sample_lens(rng: np.random.Generator, ranges: CameraRanges, sensor: Sensor) -> tuple[Sensor, LensFlaws, Spectrum]:
    """Sensor and lens, and the light that reaches the sensor."""
    place = rng.random()
    spectrum: Spectrum = "colour"
    if place < ranges.grey_scene_fraction:
        spectrum = "grey"
    elif place < ranges.grey_scene_fraction + ranges.near_infrared_scene_fraction:
        spectrum = "near-infrared"
    low, high = np.log(ranges.full_well_fraction.low), np.log(ranges.full_well_fraction.high)
    size = float(np.exp(rng.uniform(low, high)))
    is_filtered = spectrum == "near-infrared" and sensor.band_nm is None
    sensitivity = _NEAR_INFRARED_SENSITIVITY if is_filtered else 1.0
    optics = sensor.optics.model_copy(
        update={
            "natural_vignetting": True,
            "mechanical_falloff_fraction": sample_uniform(rng, ranges.vignetting_fraction),
            "scattered_fraction": sample_uniform(rng, ranges.scattered_fraction),
        }
    )
    changed = sensor.model_copy(
        update={
            "full_well_e": sensor.full_well_e * size,
            "responsivity_e_per_lux_s": sensor.responsivity_e_per_lux_s * size * sensitivity,
            "psf_sigma_px": sample_uniform(rng, ranges.psf_sigma_px),
            "optics": optics,
        }
    )
    red, blue = rng.uniform(-1.0, 1.0, 2) * ranges.lateral_color_px
    flaws = LensFlaws(
        lateral_red_px=float(red),
        lateral_blue_px=float(blue),
        bloom_fraction=sample_uniform(rng, ranges.bloom_fraction),
        ghost_fraction=float(10 ** rng.uniform(-4.5, -3.3)) if rng.random() < ranges.ghost_scene_fraction else 0.0,
        ghost_seed=int(rng.integers(2**31)),
    )
    return changed, flaws, spectrum


def _sample_window(rng: np.random.Generator, ranges: CameraRanges) -> Window | None:
    if rng.random() >= ranges.window_scene_fraction:
        return None
    dirty, scratched, wet, mirroring = rng.random(4) < (0.6, 0.5, 0.25, 0.4)
    return Window(
        seed=int(rng.integers(2**31)),
        dirt_fraction=float(rng.uniform(0.02, 0.15)) if dirty else 0.0,
        scratches=int(rng.integers(2, 15)) if scratched else 0,
        drops=int(rng.integers(3, 40)) if wet else 0,
        reflection_fraction=float(rng.uniform(0.01, 0.08)) if mirroring else 0.0,
    )


def _sample_processing(
    rng: np.random.Generator, ranges: CameraRanges, metered_fraction: float
) -> ImageProcessing | None:
    """The image processor, or None.

    Args:
        rng: of the scene.
        ranges: of the recipe.
        metered_fraction: level of a white plate; the processor makes up for what the meter leaves for highlights.
    """
    if rng.random() >= ranges.processed_scene_fraction:
        return None
    red, blue = 1.0 + rng.uniform(-1.0, 1.0, 2) * ranges.white_balance_fraction
    grey_fraction = metered_fraction * _GREY_CARD / WHITE_PAINT[1]
    # The tone curve takes x to f x / (1 + (f - 1) x): this f takes a grey card to its own reflectance.
    factor = _GREY_CARD * (1.0 - grey_fraction) / (grey_fraction * (1.0 - _GREY_CARD))
    return ImageProcessing(
        demosaic="edge-aware" if rng.random() < 0.7 else "bilinear",
        white_balance=(float(red), float(blue)),
        neutral_fraction=sample_uniform(rng, ranges.neutral_fraction),
        exposure_factor=float(np.clip(factor * 2.0 ** sample_uniform(rng, ranges.exposure_ev), 0.06, 20.0)),
        brightest_mean_fraction=sample_uniform(rng, ranges.brightest_mean_fraction),
        contrast=sample_uniform(rng, ranges.contrast),
        black_fraction=sample_uniform(rng, ranges.black_fraction),
        saturation=sample_uniform(rng, ranges.saturation),
        denoise_sigma_px=sample_uniform(rng, ranges.denoise_sigma_px),
        kept_detail_fraction=sample_uniform(rng, ranges.kept_detail_fraction),
        denoise_threshold=sample_uniform(rng, ranges.denoise_threshold),
        sharpen=sample_uniform(rng, ranges.sharpen),
        chroma_blur_px=sample_uniform(rng, ranges.chroma_blur_px),
    )


def _sample_coding(rng: np.random.Generator, ranges: CameraRanges) -> ImageCoding:
    place, scaled, interlaced = rng.random(3)
    fraction = sample_uniform(rng, ranges.resolution_fraction)
    is_jpeg = place < ranges.jpeg_scene_fraction
    is_video = not is_jpeg and place < ranges.jpeg_scene_fraction + ranges.video_scene_fraction
    return ImageCoding(
        resolution_fraction=fraction if scaled < ranges.resampled_scene_fraction else 1.0,
        is_interlaced=bool(interlaced < ranges.interlaced_scene_fraction),
        codec="jpeg" if is_jpeg else "h264-intra" if is_video else "none",
        quality=round(sample_uniform(rng, ranges.jpeg_quality)),
        quantizer=round(sample_uniform(rng, ranges.video_quantizer)),
    )


def _sample_overlay(rng: np.random.Generator, ranges: CameraRanges) -> Overlay | None:
    if rng.random() >= ranges.overlay_scene_fraction:
        return None
    timecoded, at_top, crossed, framed = (bool(drawn) for drawn in rng.random(4) < (0.8, 0.5, 0.4, 0.3))
    return Overlay(
        is_timecoded=timecoded or not crossed,
        is_at_top=at_top,
        has_crosshair=crossed,
        has_frame=framed,
        level=float(rng.uniform(0.75, 1.0)),
        opacity=float(rng.uniform(0.5, 0.9)),
    )
