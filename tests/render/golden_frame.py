"""The frame whose mean and variance `golden_render.npz` holds."""

from __future__ import annotations

from pathlib import Path

from datasets_manifest.recipe.recipe import Recipe, parse_recipe

GOLDEN = Path(__file__).parent / "golden_render.npz"
_RECIPE = """
name = "golden"
seed = 8
rig = { preset = "rgb-ideal", width_px = 96, height_px = 72, focal_px = 160.0 }
[frames]
count = 1
[distance]
law = "stations"
stations_m = [2.2]
[environment]
ground = "sea"
sun_elevation_deg = { low = 40, high = 40 }
[render]
"""


def golden_recipe(*render_lines: str) -> Recipe:
    """The recipe of the frame, with lines for its section `render`."""
    return parse_recipe(_RECIPE + "\n".join(render_lines))
