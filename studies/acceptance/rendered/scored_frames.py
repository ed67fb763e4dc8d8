"""One method on one dataset, frame by frame: errors of poses and centroids against the records and their bounds.

The bound of a centroid is the smallest error with which its marker's centre can be measured, from the light alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.special import erf

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.records import FeatureView, PairRecord
from droguekit.scoring.poses.centroid_errors import centroid_errors
from droguekit.scoring.poses.drogue_truth import DrogueTruth, drogue_truth
from droguekit.scoring.poses.pose_errors import estimates_by_method, pose_error
from geometry.se3 import Array

# The trapezoidal rule on a smooth closed curve converges faster than any power; this many points per pixel of
# circumference carry it beyond single precision for blurs down to 0.3 px.
_POINTS_PER_PX = 8
# Beyond this many standard deviations of the blur the image is flat.
_REACH_SIGMA = 6.0


@dataclass(frozen=True)
class PixelLight:
    """Electrons in pixels on and beside a disc, and the sensor's noise.

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
    """Fraction of each pixel's response that falls inside a smooth outline, exact for box and Gaussian blur.

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


BEST, CHAIN = "joint-hub", "paper"
"""Our best method, and the seed paper's."""
METHODS = (BEST, CHAIN)
"""Methods that a tier runs."""


@dataclass(frozen=True, eq=False)
class MarkerErrors:
    """Measured minus true centres of the markers of one frame.

    Attributes:
        offset_px: (K, 2).
        outward_px: (K,) part that points away from the drogue's middle.
        bound_px: (K,) smallest standard deviation of a coordinate that the light allows.
    """

    offset_px: Array
    outward_px: Array
    bound_px: Array


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """One frame.

    Attributes:
        distance_m: Z of the rim's centre. [m]
        pose: (5,) X, Y, Z [m], pitch and yaw [deg], estimate minus truth, or None without a pose.
        transverse_m: across the line of sight, 0 without a pose. [m]
        markers: of its centroids.
        unmeasured_fraction: of its lit markers in view, both eyes together.
    """

    distance_m: float
    pose: Array | None
    transverse_m: float
    markers: MarkerErrors
    unmeasured_fraction: float


Frames = Mapping[int, FrameErrors]


def score_frames(dataset: Path, estimates: Path, methods: Iterable[str]) -> dict[str, dict[int, FrameErrors]]:
    """Errors of some methods in every frame that shows a drogue.

    Raises:
        ValueError: a dataset or estimates that cannot be read, or a method that is not among them.
    """
    data = Dataset(dataset)
    found = estimates_by_method(read_estimates(estimates), data.frame_indices, str(estimates))
    missing = [name for name in methods if name not in found]
    if missing:
        raise ValueError(f"{estimates}: has no method {missing[0]!r}; there are {', '.join(found)}")
    scores: dict[str, dict[int, FrameErrors]] = {name: {} for name in methods}
    for index in data.frame_indices:
        record = data.record(index)
        truth = drogue_truth(record)
        if truth is None:
            continue
        bounds_px = center_bounds_px(record)
        for name, frames in scores.items():
            estimate = found[name].get(index)
            errors = centroid_errors(truth, estimate.features if estimate is not None else ())
            marker = ~errors.is_hub
            markers = MarkerErrors(
                errors.offset_px[marker],
                errors.outward_px[marker],
                bounds_px[errors.eye[marker], errors.feature[marker]],
            )
            lit = truth.visible[:, : truth.layout.count] & np.isfinite(bounds_px)
            unmeasured = lit.copy()
            unmeasured[errors.eye[marker], errors.feature[marker]] = False
            pose, transverse_m = _pose(estimate, truth)
            fraction = float(unmeasured.sum() / max(lit.sum(), 1))
            frames[index] = FrameErrors(truth.distance_m, pose, transverse_m, markers, fraction)
    return scores


def _pose(estimate: object, truth: DrogueTruth) -> tuple[Array | None, float]:
    if not isinstance(estimate, PoseEstimate):
        return None, 0.0
    error = pose_error(estimate.left_from_drogue, truth.left_from_drogue)
    return error.components, error.transverse_m


def between_m(frames: Frames, low_m: float, high_m: float) -> dict[int, FrameErrors]:
    """The frames whose distance lies in [low, high], with a hundredth of leeway for stations."""
    return {i: f for i, f in frames.items() if 0.99 * low_m <= f.distance_m <= 1.01 * high_m}


def pose_array(frames: Frames) -> Array:
    """(n, 5) errors of the frames with a pose. [m, deg]"""
    poses = [frame.pose for frame in frames.values() if frame.pose is not None]
    return np.array(poses, dtype=np.float64).reshape(-1, 5)
