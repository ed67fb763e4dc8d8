"""The check of a recipe as lines, as a page with a few rendered pictures, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from droguekit.workflows.recipe_check import check_lines, check_recipe, with_drogue_in_all_pairs
from droguekit.workflows.rendering import open_recipe

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import Recipe
    from droguekit.visualization.check_page import DroguePicture

# The part of an image around the drogue, in halves of its box, and at least so many pixels to each side.
_AROUND, _LEAST_AROUND_PX = 1.5, 12


def checked_lines(
    name_or_path: str, seed: int | None, engine: str | None, json_out: Path | None, html_out: Path | None
) -> Iterator[str]:
    """Check a recipe, write the results where files are named, and give the lines that describe it.

    Args:
        name_or_path: of the recipe.
        seed: replaces the recipe's, or None.
        engine: for the pictures of the page; the recipe's when None.
        json_out: file for the numbers, or None.
        html_out: page to write with three pictures and plots, or None.

    Raises:
        ValueError: no such recipe or engine, one without markers, or a picture that cannot be rendered.
        OSError: a result cannot be written.
    """
    recipe = open_recipe(name_or_path, seed, engine).recipe
    check = check_recipe(recipe)
    lines = list(check_lines(check))
    yield from lines
    if json_out is not None:
        from datasets_manifest.atomic import write_text_atomic

        write_text_atomic(json_out, json.dumps(check.to_json(), indent=1, allow_nan=False) + "\n")
        yield f"wrote {json_out}"
    if html_out is not None:
        from droguekit.visualization.check_page import write_check_page

        distances = [row.distance_m for row in check.of_light(check.lights[0].light)]
        chosen = dict.fromkeys((distances[0], distances[len(distances) // 2], distances[-1]))
        pictures = [_picture(recipe, distance_m) for distance_m in chosen]
        write_check_page(recipe.name, check.markers, pictures, lines, html_out, check.advice)
        yield f"wrote {html_out}"


def _picture(recipe: Recipe, distance_m: float) -> DroguePicture:
    """The drogue at a distance, rendered in the recipe's first scene."""
    from droguekit.batch.frame_task import process_engine, render_frame
    from droguekit.numerical_threads import one_thread
    from droguekit.visualization.check_page import DroguePicture

    law = recipe.distance.model_copy(update={"law": "stations", "stations_m": (distance_m,)})
    near = with_drogue_in_all_pairs(recipe).model_copy(update={"distance": law, "sequence": None})
    with one_thread():
        rendered = render_frame(near, 0, process_engine(recipe.render.engine))
    box, image = rendered.record.views.left.box_full_xywh_px, rendered.images.left
    assert box is not None
    left, top, width, height = box
    reach = max(int(_AROUND * max(width, height) / 2), _LEAST_AROUND_PX)
    column, row = round(left + width / 2), round(top + height / 2)
    part = image[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    return DroguePicture(distance_m, part)
