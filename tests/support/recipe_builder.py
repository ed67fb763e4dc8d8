"""Recipes for tests, built from Python values: as TOML text, or parsed.

Write a recipe's sections as keyword arguments. A module with variants of one recipe keeps it as a `RecipeTable` and
gives the changes:

    BASE: RecipeTable = {"name": "mine", "frames": {"count": 4}, "distance": stations(2.0, 5.0)}
    recipe = build_recipe(BASE, seed=3, frames={"empty_fraction": 0.5})
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypedDict, Unpack, cast

from datasets_manifest.recipe.recipe import Recipe, parse_recipe

Section = Mapping[str, Any]

# Every process that renders ground computes its texture first, for seconds; a picture of sky and ground costs nothing.
PLAIN_SKY = {"map": {"file": str(Path(__file__).with_name("plain_sky.hdr")), "cd_m2_per_unit": 1000.0}}


class RecipeTable(TypedDict, total=False):
    """The keys of a recipe, see `datasets_manifest.recipe.recipe.Recipe` and docs/reference/recipes.md."""

    name: str
    description: str
    family: str
    seed: int
    drogue: str | Path
    rig: str | Section
    frames: Section
    distance: Section
    pose: Section
    target: Section
    environment: Section
    exposure: Section
    render: Section
    outputs: Section
    split: Section
    board: Section
    rangefinder: Section
    families: Sequence[Section] | Section
    sequence: Section
    tanker: Section
    hose: Section
    receiver: Section
    neighbours: Section
    camera: Section


# The ideal eyes with an eighth and a quarter of their pixels a side, at the same field of view.
RIG_160_PX = {"preset": "rgb-ideal", "width_px": 160, "height_px": 120, "focal_px": 266.0}
RIG_320_PX = {"preset": "rgb-ideal", "width_px": 320, "height_px": 240, "focal_px": 533.0}


def stations(*distances_m: float) -> dict[str, Any]:
    """Section `distance`: frames go through these distances in turn. [m]"""
    return {"law": "stations", "stations_m": list(distances_m)}


def between(low_m: float, high_m: float, law: str = "uniform") -> dict[str, Any]:
    """Section `distance`: drawn between two distances [m] by a law: uniform, log-uniform or uniform-image-size."""
    return {"law": law, "low_m": low_m, "high_m": high_m}


def change_recipe(base: RecipeTable, /, **changes: Unpack[RecipeTable]) -> RecipeTable:
    """A copy in which keys are replaced or added, within sections too; None leaves a key out.

    The section `distance` is replaced whole, as its laws have different keys.
    """
    return cast(RecipeTable, _merged(base, changes))


def recipe_text(base: RecipeTable | None = None, /, **changes: Unpack[RecipeTable]) -> str:
    """TOML of a recipe and its changes, see `change_recipe`.

    Its streams are keyed by the seed alone, so that a test's draws do not depend on the name that it gives.
    """
    table = _merged(base or {}, changes)
    if isinstance(table.get("frames"), Mapping):
        table["frames"] = {"stream": "", **table["frames"]}
    sections = {key: value for key, value in table.items() if isinstance(value, Mapping)}
    lines = [f"{key} = {_value(value)}" for key, value in table.items() if key not in sections]
    for key, section in sections.items():
        lines += [f"[{key}]", *(f"{name} = {_value(value)}" for name, value in section.items())]
    return "\n".join(lines) + "\n"


def build_recipe(base: RecipeTable | None = None, /, **changes: Unpack[RecipeTable]) -> Recipe:
    """A recipe and its changes, see `recipe_text`, parsed as a user's TOML is.

    Raises:
        ValueError: keys or values are wrong; names each key.
    """
    return parse_recipe(recipe_text(base, **changes))


def paper_view_recipe(
    scale: float = 1.0,
    stations_m: Sequence[float] = (3.0,),
    samples: int = 16,
    speed_m_s: float = 0.0,
    rate_deg_s: float = 0.0,
    window: float = 1.0,
) -> Recipe:
    """50 pairs by the paper's rig, with its pixels a side scaled at the same field of view.

    Args:
        scale: 1 for 1280 x 960 pixels.
        stations_m: distances, in turn.
        samples: paths through each pixel of the drogue.
        speed_m_s, rate_deg_s: motion of the drogue.
        window: share of the image's width and height that the rig has, around its middle.
    """
    size = {
        "width_px": round(1280 * scale * window),
        "height_px": round(960 * scale * window),
        "focal_px": round(2133.3333 * scale, 6),
    }
    return build_recipe(
        name="render-test",
        seed=5,
        rig={"preset": "rgb-ideal", **size},
        frames={"count": 50},
        distance=stations(*stations_m),
        pose={"speed_m_s": speed_m_s, "rate_deg_s": rate_deg_s},
        render={"samples_per_px": samples},
    )


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        if value is None:
            merged.pop(key, None)
        elif key != "distance" and isinstance(old, Mapping) and isinstance(value, Mapping):
            merged[key] = _merged(old, value)
        else:
            merged[key] = value
    return merged


def _value(value: Any) -> str:
    """A value as TOML on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        return repr(float(value))
    return json.dumps(str(value))
