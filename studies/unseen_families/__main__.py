"""`python -m studies.unseen_families`: trains without each family of drogues, or type of tanker, and tests on it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from datasets_manifest.recipe.recipe import RecipeSource
from datasets_manifest.storage.layout import FRAMES_FOLDER, RECIPE_FILE, frame_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.frame import FrameSpec
from drogue_models.tankers.tanker import TankerType
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from studies.short_training import train_briefly
from studies.world_variety.detection_by_kind import (
    KindScore,
    body_kind,
    drogue_kind,
    percent,
    score_by_kind,
    tanker_kind,
)
from studies.wrong_input import wrong_input_ends

EVERYTHING = "everything"


def drogue_families_in(frame: FrameSpec) -> set[str]:
    """Families of all drogues of a frame: that which is sought, and those of other tankers."""
    seen = [each.drogue for each in frame.sought_and_neighbours() if each.drogue is not None]
    return {drogue_family(body_kind(drogue)) for drogue in seen}


def drogue_family(kind: str) -> str:
    """Family of a kind of drogue, with or without markers."""
    return kind.removesuffix(", no markers")


@dataclass(frozen=True)
class Families:
    """What is divided into families.

    Attributes:
        what: its name.
        names: of the families.
        seen_in: the families that a frame shows.
        kind_of: the kind that a frame counts for in a test.
        family_of: family of such a kind.
    """

    what: str
    names: tuple[str, ...]
    seen_in: Callable[[FrameSpec], set[str]]
    kind_of: Callable[[FrameSpec], str]
    family_of: Callable[[str], str]


FAMILIES = {
    "drogue": Families(
        "drogue", ("ring", "basket", "petals", "ribbons", "cone"), drogue_families_in, drogue_kind, drogue_family
    ),
    # A second tanker is of the first one's type.
    "tanker": Families("tanker", get_args(TankerType), lambda frame: {tanker_kind(frame)}, tanker_kind, str),
}


def link_without(corpus: Path, families: Families, family: str, out: Path) -> Path:
    """A dataset of those pairs of a corpus that show nothing of a family, as hard links where the disk allows them.

    Raises:
        ValueError: no such family, or every pair shows it, or none.
    """
    if family not in families.names:
        raise ValueError(f"{family}: choose from {', '.join(families.names)}")
    source = Dataset(corpus)
    kept = [index for index in source.frame_indices if family not in families.seen_in(source.record(index).frame)]
    if len(kept) in (0, len(source.frame_indices)):
        shows = "no pair shows" if kept else "every pair shows"
        raise ValueError(f"{corpus}: {shows} a {families.what} of the family {family}")
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


def table_lines(
    families: Families, family: str, everything: Sequence[KindScore], without: Sequence[KindScore]
) -> Iterator[str]:
    """Rows of a Markdown table for the kinds of a family."""
    for learned, unseen in zip(everything, without, strict=True):
        if families.family_of(learned.kind) == family:
            yield (
                f"| {learned.kind} | {learned.images} | {learned.drogues} | {percent(learned.ap50)} "
                f"| {percent(unseen.ap50)} |"
            )


def main(
    corpus: Annotated[Path, typer.Option("--corpus", help="Dataset to train on, such as one of detector-train.")],
    test: Annotated[Path, typer.Option("--test", help="Dataset to look for drogues in.")],
    out: Annotated[Path, typer.Option("--out", help="Folder; a stopped run goes on in it.")] = Path(
        "out/unseen-families"
    ),
    of: Annotated[
        Literal["drogue", "tanker"], typer.Option("--of", help="Leave out families of drogues or types of tankers.")
    ] = "drogue",
    image_passes: Annotated[int, typer.Option("--image-passes", min=8, help="Of each training.")] = 5184,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the trainings.")] = 0,
    family: Annotated[
        list[str] | None, typer.Option("--family", help="To leave out, in turn; all where none is named.")
    ] = None,
) -> None:
    """Train on everything and without each family, and print AP50 of the drogues in the family's images."""
    families, cache = FAMILIES[of], out / "cache"
    with wrong_input_ends("unseen_families"):
        found = train_briefly(corpus, out / EVERYTHING, cache, image_passes, seed)
        everything = list(score_by_kind(test, str(found), families.kind_of))
        typer.echo(f"| {of} | images | drogues | AP50, trained on everything | trained without the family |")
        typer.echo("|---|---|---|---|---|")
        tested = {families.family_of(score.kind) for score in everything}
        for name in family or list(families.names):
            if name not in tested:
                typer.echo(f"{test}: no pair shows a {of} of the family {name}; it is not left out", err=True)
                continue
            subset = link_without(corpus, families, name, out / "corpora" / name)
            found = train_briefly(subset, out / f"without-{name}", cache, image_passes, seed)
            without = list(score_by_kind(test, str(found), families.kind_of))
            for line in table_lines(families, name, everything, without):
                typer.echo(line)


if __name__ == "__main__":
    typer.run(main)
