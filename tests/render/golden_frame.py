"""The frame whose mean and variance `golden_render.npz` holds."""

from __future__ import annotations

from pathlib import Path

from datasets_manifest.recipe.recipe import Recipe
from tests.support.recipe_builder import build_recipe, stations

GOLDEN = Path(__file__).parent / "golden_render.npz"


def golden_recipe(**render: object) -> Recipe:
    """The recipe of the frame, with these keys in its section `render`."""
    return build_recipe(
        name="golden",
        seed=8,
        rig={"preset": "rgb-ideal", "width_px": 96, "height_px": 72, "focal_px": 160.0},
        frames={"count": 1},
        distance=stations(2.2),
        environment={"ground": "sea", "sun_elevation_deg": {"low": 40, "high": 40}},
        render=render,
    )
