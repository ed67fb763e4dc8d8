"""Numbers by which pictures of clouds differ from photographs: spread of their light, roughness and sharpness.

The same numbers are taken of photographs, so that the two can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.importers.photographs import shown_photograph
from datasets_manifest.types.environment import CloudLayer, Environment
from scenes.environment_radiance import EnvironmentRadiance
from scenes.sky.photometry import luminance

Picture = NDArray[np.float64]
_WIDTH_PX, _HEIGHT_PX, _FOCAL_PX, _SEEDS = 640, 480, 2133.0, (1, 2, 3, 4)
# Side of the squares in which slopes and spreads are measured.
_CROP_PX = 128
# Squares with less contrast than this show sky alone.
_LEAST_CONTRAST = 0.04
_LOWEST_CYCLES, _HIGHEST_CYCLES = 4, 40
# An edge is a step of at least so much of the picture's range within a few pixels.
_LEAST_STEP, _REACH_PX = 0.25, 8
# Common layers of recipes: what each looks like to a camera that looks so far up or down. [deg]
CASES: dict[str, tuple[float, dict[str, object]]] = {
    "cirrus": (25.0, {"height_above_camera_m": 4500.0, "feature_size_m": 5000.0, "optical_depth": 0.7}),
    "cumulus": (12.0, {"height_above_camera_m": 1200.0, "feature_size_m": 1800.0, "optical_depth": 12.0}),
    "cumulus below": (-14.0, {"height_above_camera_m": -1200.0, "feature_size_m": 1800.0, "optical_depth": 12.0}),
    "stratus": (
        -14.0,
        {"height_above_camera_m": -1000.0, "feature_size_m": 2500.0, "optical_depth": 18.0, "cover_fraction": 0.97},
    ),
}


def bimodality(values: Picture) -> float:
    """Sarle's coefficient: 5/9 of an even spread, 1/3 of a normal one, 1 of two values alone."""
    centred = (values - values.mean()) / values.std()
    return float((np.mean(centred**3) ** 2 + 1.0) / np.mean(centred**4))


def spectrum_slope(crop: Picture) -> float:
    """Exponent of the power of a square picture over the wave number, 4 to 40 cycles per side."""
    side = len(crop)
    window = np.outer(np.hanning(side), np.hanning(side))
    power = np.abs(np.fft.fft2((crop - crop.mean()) * window)) ** 2
    cycles = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side))) * side
    edges = np.geomspace(_LOWEST_CYCLES, _HIGHEST_CYCLES, 12)
    middle = np.sqrt(edges[1:] * edges[:-1])
    rings = [power[(cycles >= low) & (cycles < high)].mean() for low, high in pairwise(edges)]
    return float(np.polyfit(np.log(middle), np.log(rings), 1)[0])


def edge_blur_px(picture: Picture) -> float:
    """Standard deviation of the blur of the sharpest tenth of a picture's edges along rows. [px]

    A step under Gaussian blur has its height over its steepest slope, `sqrt(2 pi)` standard deviations, for its width.
    """
    span = float(np.percentile(picture, 99) - np.percentile(picture, 1))
    slope = np.abs(np.diff(picture, axis=1))
    inner = slope[:, _REACH_PX:-_REACH_PX]
    shifted = np.stack([picture[:, k : picture.shape[1] - 2 * _REACH_PX - 1 + k] for k in range(2 * _REACH_PX + 2)])
    height = shifted.max(axis=0) - shifted.min(axis=0)
    nearby = np.stack([slope[:, k : slope.shape[1] - 2 * _REACH_PX + k] for k in range(2 * _REACH_PX + 1)])
    step = (height > _LEAST_STEP * span) & (inner >= nearby.max(axis=0))
    if not step.any():
        return float("nan")
    return float(np.percentile(height[step] / inner[step], 10) / np.sqrt(2 * np.pi))


def measures(picture: Picture) -> dict[str, float]:
    """Mean of bimodality and slope over the squares that show cloud, and the blur of the whole picture's edges."""
    spreads, slopes = [], []
    for row in range(0, picture.shape[0] - _CROP_PX + 1, _CROP_PX):
        for column in range(0, picture.shape[1] - _CROP_PX + 1, _CROP_PX):
            crop = picture[row : row + _CROP_PX, column : column + _CROP_PX]
            if crop.std() > _LEAST_CONTRAST * crop.mean():
                spreads.append(bimodality(crop))
                slopes.append(spectrum_slope(crop))
    if not slopes:
        return {}
    return {
        "bimodality": float(np.mean(spreads)),
        "spectrum slope": float(np.mean(slopes)),
        "edge blur [px]": edge_blur_px(picture),
    }


def rendered(kind: str, seed: int) -> Picture:
    """(480, 640) luminance of a case under a sun 40 degrees up at the side, at the camera's resolution. [cd/m2]"""
    up_deg, table = CASES[kind]
    layer = CloudLayer.model_validate(
        {"kind": kind.split()[0], "cover_fraction": 0.5, "texture_seed": seed, "thickness_m": 600.0} | table
    )
    environment = Environment(
        sun_elevation_deg=40.0,
        sun_azimuth_deg=70.0,
        turbidity=2.5,
        visibility_m=80_000.0,
        altitude_m=4000.0,
        ground_reflectance_rgb=(0.1, 0.1, 0.06),
        ground="sea",
        ground_texture_seed=1,
        clouds=(layer,),
        sky_model="scattering",
    )
    u, v = np.meshgrid(np.arange(_WIDTH_PX) - _WIDTH_PX / 2, np.arange(_HEIGHT_PX) - _HEIGHT_PX / 2)
    return luminance(EnvironmentRadiance(environment).radiance(pitched_rays(u, v, _FOCAL_PX, up_deg)))


def pitched_rays(u_px: Picture, v_px: Picture, focal_px: float, up_deg: float) -> NDArray[np.float32]:
    """(H, W, 3) unit rays in world axes of a camera that flies east and looks so far up.

    Args:
        u_px, v_px: (H, W) columns to the right of the middle, and rows below it.
        focal_px: [px]
        up_deg: [deg]
    """
    cosine, sine = np.cos(np.radians(up_deg)), np.sin(np.radians(up_deg))
    rays = np.stack([focal_px * cosine + v_px * sine, -u_px, focal_px * sine - v_px * cosine], axis=-1)
    unit: NDArray[np.float32] = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return unit


def photographed(path: Path) -> Picture:
    """(H, W) linear luminance of an sRGB photograph.

    Raises:
        ValueError: it cannot be read; names the file.
    """
    picture = shown_photograph(path)
    encoded = (np.dstack([picture] * 3) if picture.ndim == 2 else picture) / 255.0
    return luminance(np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4))


def cloud_table(photographs: Sequence[Path] = ()) -> str:
    """The measures of the cases, and of photographs, as a table in Markdown.

    Raises:
        ValueError: a photograph cannot be read; names the file.
    """
    # First, for a picture that cannot be read shall not cost the minutes of the cases.
    of_photographs = {path.name: measures(photographed(path)) for path in photographs}
    found: dict[str, dict[str, float]] = {}
    for kind in CASES:
        each = [measures(rendered(kind, seed)) for seed in _SEEDS]
        each = [one for one in each if one]
        found[f"`{kind}`"] = {name: float(np.nanmean([one[name] for one in each])) for name in each[0]}
    names = list(next(iter(found.values())))
    found |= of_photographs
    rows = ["| picture | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
    for title, numbers in found.items():
        rows.append(f"| {title} | " + " | ".join(f"{numbers.get(name, float('nan')):.2f}" for name in names) + " |")
    return "\n".join(rows)
