"""Recipes of small pairs and short sequences, and datasets rendered from recipes, for tests of several packages.

A dataset that many tests read is a fixture of its own, see the `conftest.py` beside this file.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Unpack

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from tests.support.recipe_builder import PLAIN_SKY, RIG_160_PX, RIG_320_PX, RecipeTable, between, recipe_text

# Single pairs between 2 and 5 m, some of them without a drogue.
SINGLE_PAIRS: RecipeTable = {
    "name": "single-pairs",
    "seed": 2,
    "rig": RIG_160_PX,
    "frames": {"count": 4, "scenes": 2, "empty_fraction": 0.3},
    "distance": between(2.0, 5.0),
    "environment": PLAIN_SKY,
    "render": {"engine": "analytic"},
}

# Three sequences of 20 pairs, in which a receiver keeps its station 4 m behind the drogue.
STATION_KEEPING: RecipeTable = {
    "name": "sequence-test",
    "seed": 2,
    "frames": {"count": 60, "scenes": 2},
    "exposure": {"time_s": 0.002},
    "sequence": {"frames_per_sequence": 20, "receiver": {"manoeuvres": ["station"], "start_m": 4.0}},
}

# Near drogues, to train networks on: 40 pairs of ten scenes.
TOY: RecipeTable = {
    "name": "toy",
    "description": "Near drogues.",
    "seed": 5,
    "rig": RIG_320_PX | {"focal_px": 300.0, "encoding": "gamma"},
    "frames": {"count": 40, "scenes": 10, "empty_fraction": 0.1},
    "distance": between(2.0, 4.0, "log-uniform"),
    "environment": PLAIN_SKY,
    "render": {"engine": "analytic"},
    "split": {"train": 1.0, "val": 0.0, "test": 0.0},
}

# A receiver keeps its station behind a drogue that is let go above the wind: it swings, and shows its side to the
# receiver once or twice, so that some pairs cannot be made.
SWINGING: RecipeTable = {
    "name": "swinging",
    "frames": {"count": 20},
    "exposure": {"time_s": 0.002},
    "sequence": {
        "frames_per_sequence": 20,
        "frame_rate_hz": 5,
        "hose": {"preset": "small-uav", "airspeed_m_s": 4},
        "turbulence": "none",
        "release_m": [3.0, 0.0, 1.0],
        "receiver": {"manoeuvres": ["station"], "start_m": 4.0, "follower": {"bandwidth_hz": 0}},
    },
}


def docking_recipe(sequences: int) -> str:
    """Docking runs of six pairs each, two a second, from 2.4 to 1.7 m, each in a scene of its own."""
    return recipe_text(
        name="tiny-docking",
        seed=3,
        rig=RIG_160_PX,
        frames={"count": 6 * sequences, "scenes": sequences},
        sequence={
            "frames_per_sequence": 6,
            "frame_rate_hz": 2,
            "receiver": {"start_m": 2.4, "end_m": 1.7, "closure_m_s": 1.0, "hold_s": 0.0},
        },
        render={"engine": "analytic"},
    )


def rendered(text: str, out: Path, frames: Iterable[int] | None = None) -> Path:
    """The dataset of a recipe's frames, all of them unless some are named, in `out`: in this process, none dropped."""
    recipe, told = parse_recipe(text), io.StringIO()
    chosen = range(recipe.frames.count) if frames is None else list(frames)
    summary = render_dataset(RecipeSource(recipe, text), out, chosen, 0, PlainProgress(told))
    assert summary.drops == (), told.getvalue()
    return out


def render_toy(folder: Path, **changes: Unpack[RecipeTable]) -> Path:
    """The dataset of `TOY` with these changes, in this process."""
    return rendered(recipe_text(TOY, **changes), folder)
