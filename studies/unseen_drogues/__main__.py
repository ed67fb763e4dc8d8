"""`python -m studies.unseen_drogues`: trains without each family of drogues, and looks for drogues of that family."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from datasets_manifest.recipe.recipe import RecipeSource
from datasets_manifest.storage.layout import FRAMES_FOLDER, RECIPE_FILE, frame_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.frame import FrameSpec
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from studies.droguekit_command import run_droguekit
from studies.world_variety.detection_by_drogue import KindScore, drogue_kind, score_by_drogue

FAMILIES = ("ring", "basket", "petals", "ribbons", "cone")
EVERYTHING = "everything"


def families_in(frame: FrameSpec) -> set[str]:
    """Families of all drogues of a frame: that which is sought, and those of other tankers."""
    seen = [each.drogue for each in frame.sought_and_neighbours() if each.drogue is not None]
    return {family_of(drogue_kind(drogue)) for drogue in seen}


def family_of(kind: str) -> str:
    """Family of a kind of drogue, with or without markers."""
    return kind.removesuffix(", no markers")


def link_without(corpus: Path, family: str, out: Path) -> Path:
    """A dataset of those pairs of a corpus that show no drogue of a family, as hard links where the disk allows them.

    Raises:
        ValueError: no such family, or every pair shows a drogue of it.
    """
    if family not in FAMILIES:
        raise ValueError(f"{family}: choose from {', '.join(FAMILIES)}")
    source = Dataset(corpus)
    kept = [index for index in source.frame_indices if family not in families_in(source.record(index).frame)]
    if not kept:
        raise ValueError(f"{corpus}: every pair shows a drogue of the family {family}")
    if not out.exists():
        # Under another name until it is whole, so that a run that is stopped meanwhile begins it again.
        part = out.with_name(f"{out.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        shutil.copytree(corpus, part, copy_function=_link_pair)
        part.rename(out)
    for index in sorted(set(Dataset(out).frame_indices) - set(kept)):
        shutil.rmtree(frame_folder(out, index))
    # Every pair is there, so that this only writes the manifest.
    recipe = RecipeSource(source.manifest.recipe, (corpus / RECIPE_FILE).read_text(encoding="utf-8"))
    with out.with_suffix(".log").open("a", encoding="utf-8") as log:
        render_dataset(recipe, out, kept, 0, PlainProgress(log))
    return out


def _link_pair(source: str, target: str) -> None:
    """Link a file of a pair; copy any other, because it is written to."""
    if Path(source).parent.parent.name == FRAMES_FOLDER:
        with suppress(OSError):
            os.link(source, target)
            return
    shutil.copy2(source, target)


def train(corpus: Path, out: Path, cache: Path, passes: int, seed: int) -> Path:
    """Train a network from the start, unless that is done."""
    words: list[object] = ["--variant", "s", "--size", "320x416", "--image-passes", passes, "--seed", seed]
    if not (out / "result.json").is_file():
        run_droguekit(
            "train", corpus, "--out", out, "--cache", cache, "--threads", 1, *words, log=out.with_suffix(".log")
        )
    return out / "detector.onnx"


def table_lines(family: str, everything: Sequence[KindScore], without: Sequence[KindScore]) -> Iterator[str]:
    """Rows of a Markdown table for the kinds of drogues of a family."""
    for learned, unseen in zip(everything, without, strict=True):
        if family_of(learned.kind) == family:
            yield (
                f"| {learned.kind} | {learned.images} | {learned.drogues} | {_percent(learned.ap50)} "
                f"| {_percent(unseen.ap50)} |"
            )


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def main(
    corpus: Annotated[Path, typer.Option("--corpus", help="Dataset to train on, such as one of detector-train.")],
    test: Annotated[Path, typer.Option("--test", help="Dataset to look for drogues in.")],
    out: Annotated[Path, typer.Option("--out", help="Folder; a stopped run goes on in it.")] = Path(
        "out/unseen-drogues"
    ),
    image_passes: Annotated[int, typer.Option("--image-passes", min=8, help="Of each training.")] = 5184,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the trainings.")] = 0,
    family: Annotated[
        list[str] | None, typer.Option("--family", help="To leave out, in turn; all where none is named.")
    ] = None,
) -> None:
    """Train on everything and without each family, and print AP50 of the families' drogues."""
    chosen = family or list(FAMILIES)
    try:
        found = train(corpus, out / EVERYTHING, out / "cache", image_passes, seed)
        everything = list(score_by_drogue(test, str(found)))
        typer.echo("| drogue | images | drogues | AP50, trained on everything | trained without the family |")
        typer.echo("|---|---|---|---|---|")
        for name in chosen:
            subset = link_without(corpus, name, out / "corpora" / name)
            found = train(subset, out / f"without-{name}", out / "cache", image_passes, seed)
            for line in table_lines(name, everything, list(score_by_drogue(test, str(found)))):
                typer.echo(line)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    typer.run(main)
