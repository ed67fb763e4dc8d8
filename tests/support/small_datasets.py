"""Recipes of small pairs, and datasets rendered from such recipes, for tests of several packages.

A dataset that many tests read is a fixture of its own, see the `conftest.py` beside this file.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset

# The ideal eyes with an eighth and a quarter of their pixels a side, at the same field of view.
RIG_160_PX = """[rig]
preset = "rgb-ideal"
width_px = 160
height_px = 120
focal_px = 266.0"""
RIG_320_PX = """[rig]
preset = "rgb-ideal"
width_px = 320
height_px = 240
focal_px = 533.0"""


def single_pairs_recipe(seed: int, count: int = 4, scenes: int = 2, empty_fraction: float = 0.3) -> str:
    """Pairs that follow no sequence, between 2 and 5 m, some of them without a drogue."""
    return f"""
name = "single-pairs"
seed = {seed}
{RIG_160_PX}
[frames]
count = {count}
scenes = {scenes}
empty_fraction = {empty_fraction}
[distance]
law = "uniform"
low_m = 2.0
high_m = 5.0
[render]
engine = "analytic"
"""


def docking_recipe(sequences: int) -> str:
    """Docking runs of six pairs each, two a second, from 2.4 to 1.7 m, each in a scene of its own."""
    return f"""
name = "tiny-docking"
seed = 3
{RIG_160_PX}
[frames]
count = {6 * sequences}
scenes = {sequences}
[sequence]
frames_per_sequence = 6
frame_rate_hz = 2
[sequence.receiver]
start_m = 2.4
end_m = 1.7
closure_m_s = 1.0
hold_s = 0.0
[render]
engine = "analytic"
"""


def rendered(text: str, out: Path, frames: Iterable[int] | None = None) -> Path:
    """The dataset of a recipe's frames, all of them unless some are named, in `out`: in this process, none dropped."""
    recipe, told = parse_recipe(text), io.StringIO()
    chosen = range(recipe.frames.count) if frames is None else list(frames)
    summary = render_dataset(RecipeSource(recipe, text), out, chosen, 0, PlainProgress(told))
    assert summary.drops == (), told.getvalue()
    return out
