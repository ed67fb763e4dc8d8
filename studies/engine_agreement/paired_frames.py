"""The frames that both engines render, and a recipe with a sky image of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.drogue_ranges import DistanceLaw
from datasets_manifest.recipe.recipe import FrameCounts, Recipe, RenderSettings, load_recipe, recipe_names
from datasets_manifest.types.frame import FrameSpec
from render.engine import RenderEngine, StereoRadiance
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame

STATIONS_M = (2.0, 5.0, 10.0, 3.5, 20.0, 7.0, 40.0, 14.0)
# Day and dusk with unlit markers, then the 13 families of `world-89`, two of them with lit markers.
FAMILIES = (
    *("demo", "pose-tier-b", "pose-tier-b-dusk", "pose-tier-a", "pose-tier-a-dusk", "daylight-10m"),
    *("world-89/clear", "world-89/cumulus-above", "world-89/cumulus-below", "world-89/overcast", "world-89/above-deck"),
    *("world-89/cirrus", "world-89/between-layers", "world-89/in-haze", "world-89/sea", "world-89/low-sun"),
    *("world-89/sunset", "world-89/dusk", "world-89/moonlit-night"),
)
# Far brighter than any sky.
LAMP_CD_M2 = 1e6
_DRAWN_FROM, _SEED = "world-89/sea", 1
_HEIGHT_PX = 256
_RECIPE = """name = "own-sky"
seed = 1
rig = "rgb-ideal"

[frames]
count = 1

[distance]
law = "stations"
stations_m = [10.0]

[environment.map]
file = "sky.exr"
cd_m2_per_unit = 1.0
rotation_deg = [-180, 180]
"""


@dataclass(frozen=True, eq=False)
class PairedFrame:
    """One frame to be rendered by both engines.

    Attributes:
        family: its recipe, see `recipe_of_family`.
        distance_m: of the drogue. [m]
        frame: with a drogue.
        settings: with more samples the smaller the drogue is in the image.
    """

    family: str
    distance_m: float
    frame: FrameSpec
    settings: RenderSettings


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One frame by one engine: unchanged and with lit markers; CPU time of the unchanged one. [s]"""

    plain: StereoRadiance
    lit: StereoRadiance
    cpu_s: float


def recipe_of_family(name: str, seed: int) -> Recipe:
    """The recipe of one kind of frames.

    Args:
        name: of a recipe, or a recipe file; `recipe/family` for one family of a recipe that has them.
        seed: of the frames.

    Raises:
        ValueError: no such recipe or family.
    """
    head, _, tail = name.rpartition("/")
    if head not in recipe_names() and not Path(head).is_file():
        return load_recipe(name, seed).recipe
    recipe = load_recipe(head, seed).recipe
    chosen = tuple(family for family in recipe.families if family.name == tail)
    if not chosen:
        known = ", ".join(family.name for family in recipe.families) or "none"
        raise ValueError(f"family: recipe {head} has none named {tail!r}; there are {known}")
    return recipe.model_copy(update={"families": chosen})


def paired_frames(
    families: Sequence[str], stations_m: Sequence[float], count: int, most_samples: int, seed: int
) -> list[PairedFrame]:
    """Frames that take families and distances in turn.

    Args:
        families: see `recipe_of_family`.
        stations_m: distances of the drogue; if a rig cannot see all of it, the nearest distance at which it can. [m]
        count: number of frames.
        most_samples: per pixel of the drogue.
        seed: of the frames.

    Raises:
        ValueError: no such recipe or family, or one with real lenses or without drogues.
    """
    frames = []
    for index in range(count):
        family, station_m = families[index % len(families)], stations_m[index % len(stations_m)]
        recipe = recipe_of_family(family, seed)
        if recipe.rig.lenses is not None or recipe.frames.empty_fraction == 1:
            raise ValueError(f"family: {family} has real lenses or no drogue; engines are compared on ideal eyes")
        distance_m = max(station_m, 1.02 * recipe.rig.nearest_full_view_m(recipe.drogue.rim_radius_m))
        frame = frame_at(recipe, distance_m, count, index)
        frames.append(PairedFrame(family, distance_m, frame, _settings(recipe, distance_m, most_samples)))
    return frames


def frame_at(recipe: Recipe, distance_m: float, count: int, index: int) -> FrameSpec:
    """One of `count` frames, each in a scene of its own, with the drogue at a distance [m]."""
    changes = {
        "frames": FrameCounts(count=count, scenes=count),
        "distance": DistanceLaw(law="stations", stations_m=(distance_m,)),
    }
    # Not by `model_dump`, which would lose the folder of an environment map.
    return sample_frame(recipe.model_copy(update=changes), index)


def _settings(recipe: Recipe, distance_m: float, most_samples: int) -> RenderSettings:
    """All samples from 10 m on, fewer where the drogue has more pixels; a quarter for hose and tanker."""
    # Even squares, which samplers can stratify over a pixel.
    side = 2 * max(1, round(np.sqrt(most_samples) * min(distance_m / 10.0, 1.0) / 2))
    return recipe.render.model_copy(
        update={"samples_per_px": side**2, "surround_samples_per_px": max(4, (side // 2) ** 2)}
    )


def render_plain_and_lit(paired: PairedFrame, engine: RenderEngine) -> RenderedFrame:
    """The frame unchanged and with lit markers, by the same samples: their difference is the lamps' light alone."""
    plain = engine.render(paired.frame, paired.settings)
    lit = engine.render(with_lit_lamps(paired.frame, LAMP_CD_M2), paired.settings)
    return RenderedFrame(plain=plain, lit=lit, cpu_s=sum(plain.stage_s.values()))


def with_lit_lamps(frame: FrameSpec, luminance_cd_m2: float) -> FrameSpec:
    """The frame with markers that emit light."""
    assert frame.drogue is not None
    drogue = frame.drogue.model_copy(update={"marker_luminance_cd_m2": luminance_cd_m2})
    return frame.model_copy(update={"drogue": drogue})


def write_sky_recipe(folder: Path) -> Path:
    """Write a recipe whose sky is an image with the sun as one very bright spot, unless it is there.

    Returns:
        The recipe's file.

    Raises:
        OSError: they cannot be written.
    """
    picture, recipe = folder / "sky.exr", folder / "own-sky.toml"
    if not recipe.exists():
        folder.mkdir(parents=True, exist_ok=True)
        channels = {name: np.ascontiguousarray(values) for name, values in zip("RGB", _picture(), strict=True)}
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, channels).write(str(picture))
        # Written last: its presence shows that the image is complete.
        write_text_atomic(recipe, _RECIPE)
    return recipe


def _picture() -> NDArray[np.float32]:
    """(3, H, 2H) radiance: top row the zenith, the middle column looks east, right of it is south. [cd/m2]"""
    ambient = environment_radiance(sample_frame(recipe_of_family(_DRAWN_FROM, _SEED), 0).environment)
    polar = (np.arange(_HEIGHT_PX) + 0.5) * np.pi / _HEIGHT_PX
    azimuth = np.pi - (np.arange(2 * _HEIGHT_PX) + 0.5) * np.pi / _HEIGHT_PX
    across, up = np.sin(polar)[:, None], np.broadcast_to(np.cos(polar)[:, None], (_HEIGHT_PX, 2 * _HEIGHT_PX))
    directions = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=-1)
    picture = ambient.radiance(directions.astype(np.float32)).astype(np.float32)
    row, column = np.unravel_index(int(np.argmax(directions @ ambient.beam_direction)), up.shape)
    solid_angle_sr = (np.pi / _HEIGHT_PX) ** 2 * np.sin(polar[row])
    picture[row, column] += (ambient.beam_illuminance_lux / solid_angle_sr).astype(np.float32)
    result: NDArray[np.float32] = np.moveaxis(picture, -1, 0)
    return result
