"""`python -m studies.engine_agreement.detection_agreement`: detectors on two engines' pictures of the same frames.

The frames are those of the detectors' test set. Every detector that ships has learned from Mitsuba's pictures.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.recipe.recipe import load_recipe
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from studies.world_variety.detection_by_kind import drogue_kind, score_by_kind, scores_side_by_side
from studies.wrong_input import wrong_input_ends

TEST_SET = Path(__file__).parents[1] / "detector_weights" / "test.toml"


def render_by_engines(out: Path, recipe: str, engines: tuple[str, str], pairs: int, workers: int) -> dict[str, Path]:
    """Folders of the first pairs of a recipe, by engine; what is there is not rendered again.

    Raises:
        ValueError: an engine cannot be used, or the recipe has fewer pairs.
        OSError: a folder cannot be written.
    """
    folders = {engine: out / engine for engine in engines}
    for engine, folder in folders.items():
        source = load_recipe(recipe, changes={"render": {"engine": engine}})
        render_dataset(source, folder, range(pairs), workers, PlainProgress(sys.stderr))
    return folders


def main(
    out: Path,
    detector: Annotated[
        list[str] | None, typer.Option("--detector", help="One that ships, or a file; may be repeated; default both.")
    ] = None,
    engine: Annotated[tuple[str, str], typer.Option("--engines", help="The two engines.")] = ("mitsuba", "blender"),
    recipe: Annotated[str, typer.Option("--recipe", help="Name, or a .toml file.")] = str(TEST_SET),
    pairs: Annotated[int, typer.Option("--pairs", min=1, help="Number of pairs, from the first on.")] = 160,
    workers: Annotated[int, typer.Option("--workers", min=1, help="That render.")] = 1,
) -> None:
    """Render by both engines, and print a table of scores by the kind of drogue for each detector."""
    with wrong_input_ends("detection_agreement"):
        folders = render_by_engines(out, recipe, engine, pairs, workers)
        for name in detector or ["mobile-l", "mobile-s"]:
            print(f"\n{name}\n")
            scores = {by: list(score_by_kind(folder, name, drogue_kind)) for by, folder in folders.items()}
            print("\n".join(scores_side_by_side(scores)), flush=True)


if __name__ == "__main__":
    typer.run(main)
