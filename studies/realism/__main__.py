"""Prints how far modelled skies, clouds and grounds are from real ones, and how many scenes look different."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.types.environment import GROUND_KINDS, Environment, SkyModel
from droguekit.cli.main import DONE, WRONG_INPUT, explain
from droguekit.output_streams import printable
from scenes.atmosphere.air_layers import horizon_dip_rad
from scenes.environment_radiance import EnvironmentRadiance
from scenes.sky.photometry import direction_from_angles, luminance
from studies.realism.blind_test import make_test, score
from studies.realism.cloud_measures import cloud_table
from studies.realism.cloud_sheet import write_cloud_sheet
from studies.realism.ground_measures import ground_table
from studies.realism.scene_variety import variety_table

SKY_MODELS: tuple[SkyModel, ...] = ("daylight", "scattering")
# The visibilities at which both have a common clear day: around the camera, and at the ground.
_VISIBILITY_M: dict[SkyModel, float] = {"daylight": 120_000.0, "scattering": 70_000.0}
_DISC_STEP_DEG = 0.05


@dataclass(frozen=True)
class SkyMeasure:
    """One number of a sky.

    Attributes:
        name: what it is.
        expected: what is measured, or follows from geometry, with its source.
        measure: takes the model.
    """

    name: str
    expected: str
    measure: Callable[[SkyModel], float]


def _around(model: SkyModel, sun_deg: float, altitude_m: float, turbidity: float = 2.5) -> EnvironmentRadiance:
    environment = Environment(
        sun_elevation_deg=sun_deg,
        sun_azimuth_deg=0.0,
        turbidity=turbidity,
        visibility_m=_VISIBILITY_M[model],
        altitude_m=altitude_m,
        ground_reflectance_rgb=(0.1, 0.1, 0.06),
        ground_texture_seed=1,
        sky_model=model,
    )
    return EnvironmentRadiance(environment)


def _sky(around: EnvironmentRadiance, elevation_deg: float, azimuths_deg: Sequence[float]) -> NDArray[np.float64]:
    rays = np.stack([direction_from_angles(elevation_deg, azimuth) for azimuth in azimuths_deg])
    mean: NDArray[np.float64] = around.sky.radiance(rays).mean(axis=0, dtype=np.float64)
    return mean


_AWAY = (60.0, 90.0, 120.0, 150.0, 180.0)


def glow_blue_over_red(model: SkyModel) -> float:
    """Blue over red 1 degree up, from 3 km, over a sun 4 degrees down."""
    light = _sky(_around(model, -4.0, 3000.0), 1.0, (0.0,))
    return float(light[2] / light[0])


def glow_8_over_horizon(model: SkyModel, altitude_m: float = 3000.0) -> float:
    """Luminance 8 degrees up over that 1 degree up, over a sun 4 degrees down."""
    around = _around(model, -4.0, altitude_m)
    return float(luminance(_sky(around, 8.0, (0.0,))) / luminance(_sky(around, 1.0, (0.0,))))


def whitening(model: SkyModel) -> float:
    """Luminance 20 degrees up over that at the horizon by day, away from the sun."""
    around = _around(model, 40.0, 10.0)
    return float(luminance(_sky(around, 20.0, _AWAY)) / luminance(_sky(around, 0.3, _AWAY)))


def day_blue_over_red(model: SkyModel) -> float:
    """Blue over red 3 degrees up by day, away from the sun."""
    light = _sky(_around(model, 40.0, 10.0), 3.0, _AWAY)
    return float(light[2] / light[0])


def high_blue_over_red(model: SkyModel) -> float:
    """Blue over red 3 degrees above the horizon that is seen from 3 km, by day, away from the sun."""
    dip_deg = float(np.degrees(horizon_dip_rad(3000.0))) if model == "scattering" else 0.0
    light = _sky(_around(model, 40.0, 3000.0), 3.0 - dip_deg, _AWAY)
    return float(light[2] / light[0])


def setting_deg(model: SkyModel) -> float:
    """Elevation of the sun at which the last of its disc is drawn, from 3 km up."""
    last = 0.0
    for elevation_deg in np.arange(1.0, -3.0, -_DISC_STEP_DEG):
        sky = _around(model, float(elevation_deg), 3000.0).sky
        upright = np.radians(elevation_deg + np.linspace(-0.26, 0.26, 27))
        rays = np.stack([np.cos(upright), np.zeros(27), np.sin(upright)], axis=-1)[None].astype(np.float32)
        disc = np.zeros(rays.shape, dtype=np.float32)
        sky.add_discs(disc, rays, 1.0)
        if disc.any():
            last = float(elevation_deg)
    return last


def illuminance_lux(model: SkyModel, sun_deg: float) -> float:
    """Illuminance of level ground under the clear sky. [lux]"""
    return float(luminance(_around(model, sun_deg, 10.0).ground_illuminance_lux))


SKY_MEASURES: tuple[SkyMeasure, ...] = (
    SkyMeasure("B/R 1 deg over a sun at -4 deg, from 3 km", "below 0.5: the glow is red", glow_blue_over_red),
    SkyMeasure("Y(8 deg) / Y(1 deg) over it, from 3 km", "below 1: brightest low", glow_8_over_horizon),
    SkyMeasure(
        "Y(8 deg) / Y(1 deg) over it, at the ground",
        "haze hides the lowest glow",
        lambda model: glow_8_over_horizon(model, 10.0),
    ),
    SkyMeasure("Y(20 deg) / Y(0) by day", "0.61 (CIE clear), 0.49 (an HDRI)", whitening),
    SkyMeasure("B/R 3 deg up by day", "1.25 to 1.4", day_blue_over_red),
    SkyMeasure("B/R 3 deg over the horizon seen from 3 km", "bluer than from the ground", high_blue_over_red),
    SkyMeasure("sun sets from 3 km at [deg]", "-1.76 - 0.27 (dip, radius)", setting_deg),
    SkyMeasure("illuminance at -0.833 deg [lux]", "410 to 585", lambda model: illuminance_lux(model, -0.833)),
    SkyMeasure("illuminance at -6 deg [lux]", "2.0 to 3.5", lambda model: illuminance_lux(model, -6.0)),
    SkyMeasure("illuminance at -12 deg [lux]", "0.004 to 0.008", lambda model: illuminance_lux(model, -12.0)),
)


def first_background_s(model: SkyModel) -> float:
    """Processor seconds until the first 80 x 60 rays of a new scene are known, its tables included. [s]"""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 80), np.linspace(0.2, -0.2, 60))
    rays = np.stack([np.ones_like(x), x, y], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    started = time.process_time()
    _around(model, 33.0, 2000.0, 2.2).radiance(rays)
    return time.process_time() - started


def sky_table() -> str:
    """The measures of both models, as a table in Markdown."""
    rows = ["| measure | expected | " + " | ".join(f"`{model}`" for model in SKY_MODELS) + " |", "|---|---|---|---|"]
    for item in SKY_MEASURES:
        cells = [f"{item.measure(model):.3g}" for model in SKY_MODELS]
        rows.append(f"| {item.name} | {item.expected} | {' | '.join(cells)} |")
    # Ground textures are made once a process.
    first_background_s("daylight")
    cells = [f"{first_background_s(model):.2g}" for model in SKY_MODELS]
    rows.append(f"| CPU s of a scene's first 80 x 60 rays | 1 to 3 | {' | '.join(cells)} |")
    return "\n".join(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print.

    Returns:
        The exit code.
    """
    parser = argparse.ArgumentParser(prog="python -m studies.realism", description=__doc__)
    parts = parser.add_subparsers(dest="part", required=True)
    parts.add_parser("sky", help="colours and luminances of the clear sky")
    clouds = parts.add_parser("clouds", help="shapes and edges of clouds")
    clouds.add_argument("--photographs", nargs="*", type=Path, default=[], help="pictures of clouds to measure too")
    sheet = parts.add_parser("cloud-sheet", help="draw one picture of each kind of cloud")
    sheet.add_argument("--out", type=Path, required=True, help="a PNG or JPEG file")
    ground = parts.add_parser("ground", help="share of the ground's pictures that is noise")
    ground.add_argument("--kinds", nargs="+", choices=GROUND_KINDS, default=GROUND_KINDS, help="of ground")
    variety = parts.add_parser("variety", help="how many scenes of recipes look different")
    variety.add_argument("recipes", nargs="+", metavar="RECIPE", help="name of a recipe, or a .toml file")
    variety.add_argument("--family", nargs="+", metavar="NAME", default=(), help="of these families alone")
    blind = parts.add_parser("blind-test", help="mix pictures of ours and photographs for judges who do not know which")
    blind.add_argument("recipe", metavar="RECIPE", help="name of a recipe, or a .toml file")
    blind.add_argument("--photographs", nargs="+", type=Path, required=True, help="of sky, clouds and land")
    blind.add_argument("--count", type=int, default=24, help="of either kind (default: 24)")
    blind.add_argument("--seed", type=int, default=1, help="of windows and order (default: 1)")
    blind.add_argument("--out", type=Path, required=True, help="a new folder")
    judged = parts.add_parser("blind-score", help="which share judges took for photographs")
    judged.add_argument("key", type=Path, help="key.json of the test")
    judged.add_argument("answers", nargs="+", type=Path, help="CSV files: number,answer (photograph or render)")
    given = parser.parse_args(arguments)
    try:
        _run(given)
    except (OSError, ValueError) as error:
        print(f"realism: error: {printable(explain(error))}", file=sys.stderr)
        return WRONG_INPUT
    return DONE


def _run(given: argparse.Namespace) -> None:
    if given.part == "blind-test":
        make_test(load_recipe(given.recipe).recipe, given.photographs, given.count, given.out, given.seed)
    elif given.part == "blind-score":
        print(score(given.key, given.answers))
    elif given.part == "sky":
        print(sky_table())
    elif given.part == "clouds":
        print(cloud_table(given.photographs))
    elif given.part == "cloud-sheet":
        write_cloud_sheet(given.out)
    elif given.part == "variety":
        # All are read before the first is measured, which takes minutes.
        recipes = [load_recipe(name).recipe for name in given.recipes]
        for recipe in recipes:
            print(variety_table(recipe, given.family), flush=True)
    else:
        print(ground_table(tuple(given.kinds)))


if __name__ == "__main__":
    sys.exit(main())
