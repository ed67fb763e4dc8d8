"""How much of pictures of the ground is noise: fine texture without form, which photographs hardly have."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.environment import Environment, GroundKind
from scenes.environment_radiance import EnvironmentRadiance
from scenes.ground.ground_radiance import MEAN_REFLECTANCE
from scenes.sky.photometry import luminance

PATCH_PX = 128
"""Width and height of a patch. [px]"""
_LAG_PX, _NOISE_BELOW = 8, 0.1
_LEAST_CONTRAST = 0.004
_WIDTH_PX, _HEIGHT_PX, _FOCAL_PX = 1280, 960, 2200.0
_SEEDS = (3, 11)
# Altitude [m] and pitch [deg] of the camera.
_VIEWS = ((30.0, -6.0), (1000.0, -12.0), (6000.0, -24.0))


def lag_correlation(patch: NDArray[np.floating[Any]], lag_px: int = _LAG_PX) -> float:
    """Mean correlation of a (H, W) patch with itself shifted across and down; 0 for white noise.

    A plane is subtracted first, so that a gradient of light is no form.
    """
    rows, columns = np.indices(patch.shape, dtype=np.float64)
    terms = np.stack([np.ones(patch.size), rows.ravel(), columns.ravel()], axis=-1)
    flat = patch.ravel().astype(np.float64)
    rest = (flat - terms @ np.linalg.lstsq(terms, flat, rcond=None)[0]).reshape(patch.shape)
    variance = float((rest * rest).mean())
    across = float((rest[:, lag_px:] * rest[:, :-lag_px]).mean())
    down = float((rest[lag_px:] * rest[:-lag_px]).mean())
    return 0.5 * (across + down) / max(variance, 1e-30)


def noise_patches(image: NDArray[np.floating[Any]]) -> tuple[int, int]:
    """Numbers of patches of a (H, W) image of luminance that are noise, and of those that show something.

    A patch shows something when its deviation is 0.4 % of its mean or more; it is noise when its correlation at 8 px
    is below 0.1.
    """
    noisy = shown = 0
    for top in range(0, image.shape[0] - PATCH_PX + 1, PATCH_PX):
        for left in range(0, image.shape[1] - PATCH_PX + 1, PATCH_PX):
            patch = image[top : top + PATCH_PX, left : left + PATCH_PX]
            if float(patch.std()) < _LEAST_CONTRAST * float(patch.mean()):
                continue
            shown += 1
            noisy += lag_correlation(patch) < _NOISE_BELOW
    return noisy, shown


@dataclass(frozen=True)
class GroundNoise:
    """Patches of one kind of ground over all views.

    Attributes:
        kind: of ground.
        noisy, shown: numbers of patches; see `noise_patches`.
        cpu_s: mean processor time of a view of 1280 x 960, sky included. [s]
    """

    kind: GroundKind
    noisy: int
    shown: int
    cpu_s: float


def ground_noise(kind: GroundKind) -> GroundNoise:
    """Noise of the land below the horizon without sensor noise, from 30 m, 1 km and 6 km."""
    noisy = shown = 0
    spent_s = []
    for altitude_m, pitch_deg in _VIEWS:
        for seed in _SEEDS:
            around = EnvironmentRadiance(_environment(kind, altitude_m, seed))
            rays = _rays(pitch_deg)
            # Textures are made once a process.
            around.radiance(rays[::8, ::8])
            started = time.process_time()
            image = luminance(around.radiance(rays))
            spent_s.append(time.process_time() - started)
            below = int(np.argmax(rays[:, 0, 2] < -0.005))
            part = noise_patches(image[below:])
            noisy, shown = noisy + part[0], shown + part[1]
    return GroundNoise(kind, noisy, shown, float(np.mean(spent_s)))


def _environment(kind: GroundKind, altitude_m: float, seed: int) -> Environment:
    return Environment(
        sun_elevation_deg=35.0,
        sun_azimuth_deg=70.0,
        turbidity=2.6,
        visibility_m=100_000.0,
        altitude_m=altitude_m,
        ground=kind,
        ground_reflectance_rgb=MEAN_REFLECTANCE[kind],
        ground_texture_seed=seed,
    )


def _rays(pitch_deg: float) -> NDArray[np.float32]:
    """(960, 1280, 3) directions of a level camera that looks east and down."""
    u, v = np.meshgrid(np.arange(_WIDTH_PX) - (_WIDTH_PX - 1) / 2, np.arange(_HEIGHT_PX) - (_HEIGHT_PX - 1) / 2)
    cosine, sine = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    rays = np.stack([cosine * _FOCAL_PX + sine * v, -u, sine * _FOCAL_PX - cosine * v], axis=-1)
    result: NDArray[np.float32] = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return result


def ground_table(kinds: tuple[GroundKind, ...]) -> str:
    """Noise of kinds of ground, as a table in Markdown."""
    rows = ["| ground | patches | noise [%] | CPU s a view |", "|---|---|---|---|"]
    found = [ground_noise(kind) for kind in kinds]
    for one in found:
        rows.append(f"| `{one.kind}` | {one.shown} | {_percent(one.noisy, one.shown)} | {one.cpu_s:.2f} |")
    noisy, shown = sum(one.noisy for one in found), sum(one.shown for one in found)
    cpu_s = float(np.mean([one.cpu_s for one in found]))
    rows.append(f"| all | {shown} | {_percent(noisy, shown)} | {cpu_s:.2f} |")
    return "\n".join(rows)


def _percent(noisy: int, shown: int) -> str:
    return f"{100.0 * noisy / max(shown, 1):.1f}"
