"""The smallest error of a marker's centre that the light in a frame allows, from its record."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import FeatureView, PairRecord
from geometry.se3 import Array
from studies.acceptance.rendered.centroid_bounds import PixelLight, center_bound_px

# The bound falls smoothly with radius and light: within these steps it changes by less than the measured ratio's error.
_RADIUS_STEP_PX = 0.25
_RELATIVE_STEP = 0.05


def center_bounds_px(record: PairRecord) -> Array:
    """(2, N) Cramer-Rao bounds of the markers' centres, root mean square of both coordinates. [px]

    The light follows from each marker's signal-to-noise ratio; a marker without signal has an infinite bound.

    Raises:
        ValueError: a record without a drogue.
    """
    frame = record.frame
    if frame.drogue is None or record.left_from_drogue is None:
        raise ValueError("record: shows no drogue")
    radius_px = frame.rig.camera.fx_px * frame.drogue.marker_radius_m / float(record.left_from_drogue.translation_m[2])
    views = (record.views.left, record.views.right)
    return np.array([[_bound_px(frame, marker, radius_px) for marker in view.markers] for view in views])


def contrast_from_snr(signal_to_noise: float, background_share: float, read_noise_e: float) -> float:
    """Contrast of a disc, from contrast over noise at the mean of disc and background.

    Args:
        signal_to_noise: `c / sqrt(c / 2 + b + read^2)`, c the contrast and b the background. (`FeatureView`)
        background_share: b / c.
        read_noise_e: [electrons]

    Returns:
        c, the positive root. [electrons]
    """
    half = signal_to_noise**2 * (0.5 + background_share) / 2
    return float(half + np.sqrt(half**2 + (signal_to_noise * read_noise_e) ** 2))


def background_share(frame: FrameSpec) -> float:
    """Face over contrast of marker and face, in the channel where they differ most; both lie in the same light."""
    drogue = frame.drogue
    if drogue is None:
        raise ValueError("frame: shows no drogue")
    pairs = zip(drogue.marker_reflectance_rgb, drogue.face_reflectance_rgb, strict=True)
    contrast, face = max((marker - face, face) for marker, face in pairs)
    return face / contrast if contrast > 0 else 1.0


def _bound_px(frame: FrameSpec, marker: FeatureView, radius_px: float) -> float:
    if marker.signal_to_noise <= 0:
        return float("inf")
    sensor = frame.sensor
    contrast_e = contrast_from_snr(marker.signal_to_noise, background_share(frame), sensor.read_noise_e)
    full_dn = 2**sensor.adc_bits - 1 - sensor.black_level_dn
    step_e = sensor.full_well_e / (frame.exposure.gain * full_dn) * 2 ** (sensor.adc_bits - sensor.output_bits)
    rounded_e = float(np.exp(_RELATIVE_STEP * round(np.log(contrast_e) / _RELATIVE_STEP)))
    return _cached_bound_px(
        _RADIUS_STEP_PX * max(1, round(radius_px / _RADIUS_STEP_PX)),
        PixelLight(
            background_share(frame) * rounded_e,
            rounded_e,
            sensor.read_noise_e,
            step_e,
            sensor.psf_sigma_px,
            sensor.prnu_fraction,
        ),
    )


@lru_cache(maxsize=4096)
def _cached_bound_px(radius_px: float, light: PixelLight) -> float:
    return center_bound_px(radius_px, light)
