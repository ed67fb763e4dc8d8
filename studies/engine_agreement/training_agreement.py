"""`python -m studies.engine_agreement.training_agreement`: what a detector learns from either engine's pictures.

The small network is trained on the same frames by each engine, and tested on one dataset.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.engine_agreement.detection_agreement import render_by_engines
from studies.short_training import train_briefly
from studies.world_variety.detection_by_kind import drogue_kind, percent, score_by_kind, scores_side_by_side
from studies.wrong_input import wrong_input_ends


def main(
    out: Path,
    test: Annotated[Path, typer.Option("--test", help="Dataset to look for drogues in.")],
    engine: Annotated[tuple[str, str], typer.Option("--engines", help="The two engines.")] = ("mitsuba", "blender"),
    recipe: Annotated[str, typer.Option("--recipe", help="To learn from: name, or a .toml file.")] = "detector-train",
    pairs: Annotated[int, typer.Option("--pairs", min=1, help="Number of pairs, from the first on.")] = 140,
    image_passes: Annotated[int, typer.Option("--image-passes", min=8, help="Of each training.")] = 5184,
    seed: Annotated[list[int] | None, typer.Option("--seed", min=0, help="May be repeated; default 0.")] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="That render.")] = 1,
) -> None:
    """Render by both engines, train on either, and print a table of scores on the test set for each seed."""
    with wrong_input_ends("training_agreement"):
        folders = render_by_engines(out, recipe, engine, pairs, workers)
        for each in seed or [0]:
            scores = {}
            for name, folder in folders.items():
                found = train_briefly(folder, out / f"{name}-seed-{each}", out / "cache", image_passes, each)
                scores[f"by {name}"] = list(score_by_kind(test, str(found), drogue_kind))
            print(f"\nseed {each}\n")
            print("\n".join(scores_side_by_side(scores)))
            print(
                "AP of all:", ", ".join(f"{name} {percent(rows[-1].ap)}" for name, rows in scores.items()), flush=True
            )


if __name__ == "__main__":
    typer.run(main)
