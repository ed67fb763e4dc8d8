"""The frames that both engines render, and their light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datasets_manifest.frame import FrameSpec
from datasets_manifest.recipe import Recipe, RenderSettings, load_recipe
from render.engine import RenderEngine, StereoRadiance
from scenes.sampler import sample_frame

STATIONS_M = (2.0, 5.0, 10.0, 3.5, 20.0, 7.0, 40.0, 14.0)
# Far brighter than any sky.
LAMP_CD_M2 = 1e6


@dataclass(frozen=True, eq=False)
class PairedFrame:
    """One frame to be rendered by both engines.

    Attributes:
        family: the recipe it is drawn from.
        distance_m: of the drogue. [m]
        frame: with a drogue.
        settings: as many samples as its size in the image can afford.
    """

    family: str
    distance_m: float
    frame: FrameSpec
    settings: RenderSettings


@dataclass(frozen=True, eq=False)
class Rendered:
    """One frame by one engine: as it is, and with the markers lit; CPU time of the first of both. [s]"""

    plain: StereoRadiance
    lit: StereoRadiance
    cpu_s: float


def paired_frames(
    families: Sequence[str], stations_m: Sequence[float], count: int, most_samples: int, seed: int
) -> list[PairedFrame]:
    """Frames that go through families and distances in turn.

    Args:
        families: names of recipes, or recipe files.
        stations_m: distances of the drogue; where a rig cannot see all of it, the nearest at which it can. [m]
        count: number of frames.
        most_samples: through a pixel of the drogue.
        seed: of everything drawn.

    Raises:
        ValueError: no such recipe.
    """
    frames = []
    for index in range(count):
        family, station_m = families[index % len(families)], stations_m[index % len(stations_m)]
        recipe, _ = load_recipe(family, seed)
        distance_m = max(station_m, 1.02 * recipe.rig.nearest_full_view_m(recipe.drogue.rim_radius_m))
        frame = sample_frame(_at(recipe, distance_m, count), index)
        frames.append(PairedFrame(family, distance_m, frame, _settings(recipe, distance_m, most_samples)))
    return frames


def _at(recipe: Recipe, distance_m: float, count: int) -> Recipe:
    changes = {
        "frames": {"count": count, "scenes": count, "empty_fraction": 0.0},
        "distance": {"law": "stations", "stations_m": (distance_m,)},
    }
    return Recipe.model_validate({**recipe.model_dump(), **changes})


def _settings(recipe: Recipe, distance_m: float, most_samples: int) -> RenderSettings:
    """All samples from 5 m on, fewer where the drogue has more pixels; hose and tanker a quarter of that."""
    # Even squares, which samplers can spread evenly over a pixel.
    side = 2 * max(1, round(np.sqrt(most_samples) * min(distance_m / 5.0, 1.0) / 2))
    return recipe.render.model_copy(
        update={"samples_per_px": side**2, "surround_samples_per_px": max(4, (side // 2) ** 2)}
    )


def render_both(paired: PairedFrame, engine: RenderEngine) -> Rendered:
    """The frame as it is and with lit markers, from the same samples: their difference is the lamps' light alone."""
    plain = engine.render(paired.frame, paired.settings)
    lit = engine.render(lamps_lit(paired.frame, LAMP_CD_M2), paired.settings)
    return Rendered(plain, lit, sum(plain.stage_s.values()))


def lamps_lit(frame: FrameSpec, luminance_cd_m2: float) -> FrameSpec:
    """The frame with its markers shining by themselves."""
    assert frame.drogue is not None
    drogue = frame.drogue.model_copy(update={"marker_luminance_cd_m2": luminance_cd_m2})
    return frame.model_copy(update={"drogue": drogue})
