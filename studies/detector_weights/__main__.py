"""`python -m studies.detector_weights`: makes the weights of a shipped detector anew, and scores them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from datasets_manifest.recipe.recipe import Recipe, RecipeSource, load_recipe
from datasets_manifest.storage.reader import Dataset
from droguekit.batch.progress import progress_report
from droguekit.batch.render_dataset import render_dataset
from nav.detector.detector_registry import network_file
from nav.training.training_run import ONNX_FILE
from nav.training.training_state import BEST_FILE
from scenes.sampler import scene_of_frame
from studies.detector_weights.plain_grounds import write_plain_grounds
from studies.detector_weights.public_photographs import TEST_PACKAGES, TRAINING_PACKAGES, fetch_photographs
from studies.droguekit_command import run_droguekit
from studies.world_variety.detection_by_kind import drogue_kind, score_by_kind, scores_side_by_side

_HERE = Path(__file__).parent
# Of `detector-train`. The even ones behind the first 320 come from a run that was begun with more frames.
CORPUS_FRAMES = sorted({*range(320), *range(1, 1440, 2)} | {330, 340, 370, 380, 384, 404, 424, 430})
# Of `more-scenes.toml`: as many as its rendering had completed when the training began.
MORE_SCENES = 217
# Of `detector-negatives`, for the same reason.
NEGATIVE_SCENES = 240
# Flat rings without paths of light: pictures of a renderer that no other corpus has, at the others' size.
FLAT = {
    "name": "detector-flat",
    "seed": 9,
    "frames": {"count": 200, "scenes": 200, "empty_fraction": 0.1},
    "rig": {
        "preset": "rgb-ideal",
        "encoding": "gamma",
        "width_px": 640,
        "height_px": 480,
        "focal_px": 1066.6666666666667,
    },
    "render": {"engine": "analytic"},
}
# Folders of the corpora that the first training learns from, and of those that the others have besides.
FIRST_CORPORA, OTHER_CORPORA = ("corpus", "more"), ("negatives", "flat")
# Beside the photographs of the third training.
PLAIN_GROUNDS = 24
# Frames without a drogue, two images each, to count false boxes in: the test set's, but for scenes and seed.
EMPTY = {"name": "detector-empty", "seed": 5, "frames": {"count": 300, "scenes": 100, "empty_fraction": 1.0}}


def frames_of_first_scenes(recipe: Recipe, scenes: int) -> list[int]:
    """Indices of all frames of the scenes that the first frames show, one each."""
    first = {scene_of_frame(recipe, index) for index in range(scenes)}
    return [index for index in range(recipe.frames.count) if scene_of_frame(recipe, index) in first]


def make_weights(variant: str, out: Path, workers: int, device: str) -> Path:
    """Fetch photographs, render corpora and test sets, and train three times; what is there is not made again.

    Returns:
        The file of the trained network.
    """
    say = typer.echo
    say(f"photographs of {', '.join(TRAINING_PACKAGES + TEST_PACKAGES)}")
    fetch_photographs(out / "photographs", TRAINING_PACKAGES)
    fetch_photographs(out / "test-photographs", TEST_PACKAGES)
    for name, (source, frames) in _datasets().items():
        say(f"{name}: {len(frames)} pairs of {source.recipe.name}")
        render_dataset(source, out / name, frames, workers, progress_report())
    log = out / "log.txt"
    say(f"training; {log} tells how far it is")
    every = [out / name for name in FIRST_CORPORA + OTHER_CORPORA]
    photographs, on_grounds = out / "photographs", out / "photographs-and-grounds"
    shutil.rmtree(on_grounds, ignore_errors=True)
    shutil.copytree(photographs, on_grounds)
    write_plain_grounds(on_grounds / "plain-grounds", PLAIN_GROUNDS)
    before: Path | None = None
    for name, corpora, pictures in (
        ("first", every[: len(FIRST_CORPORA)], photographs),
        ("second", every, photographs),
        ("third", every, on_grounds),
    ):
        trained = out / f"{variant}-{name}"
        words = ["--out", trained, "--settings", _HERE / f"{variant}-{name}.toml", "--photographs", pictures]
        words += [] if before is None else ["--start-from", before / BEST_FILE]
        run_droguekit("train", *corpora, *words, "--device", device, "--cache", out / "cache", log=log)
        before = trained
    assert before is not None
    return before / ONNX_FILE


def _datasets() -> dict[str, tuple[RecipeSource, Sequence[int]]]:
    """Recipe and frames of each folder."""
    more, negatives = load_recipe(str(_HERE / "more-scenes.toml")), load_recipe("detector-negatives")
    test = str(_HERE / "test.toml")
    whole = {
        "flat": load_recipe("detector-small", changes=FLAT),
        "test": load_recipe(test),
        "empty": load_recipe(test, changes=EMPTY),
    }
    return {
        "corpus": (load_recipe("detector-train"), CORPUS_FRAMES),
        "more": (more, frames_of_first_scenes(more.recipe, MORE_SCENES)),
        "negatives": (negatives, frames_of_first_scenes(negatives.recipe, NEGATIVE_SCENES)),
        **{name: (source, range(source.recipe.frames.count)) for name, source in whole.items()},
    }


def score_lines(out: Path, detectors: dict[str, Path]) -> Iterator[str]:
    """A Markdown table of scores on the test set by drogue, and how many pictures without a drogue have a box."""
    yield from scores_side_by_side(
        {name: list(score_by_kind(out / "test", str(path), drogue_kind)) for name, path in detectors.items()}
    )
    for name, path in detectors.items():
        last = list(score_by_kind(out / "empty", str(path), drogue_kind))[-1]
        yield f"{name}: {last.false_boxes} boxes in {last.images} images of frames without a drogue"
        boxes = out / f"photographs-{name}.json"
        words = ["--detector", path, "--mono", "--out", boxes]
        run_droguekit("detect", out / "test-photographs", *words, log=out / "log.txt")
        found = json.loads(boxes.read_text(encoding="utf-8"))
        with_box = {annotation["image_id"] for annotation in found["annotations"]}
        yield f"{name}: boxes in {len(with_box)} of {len(found['images'])} photographs without a drogue"


def main(
    variant: Annotated[Literal["l", "s"], typer.Option("--variant", help="Of the network.")] = "l",
    device: Annotated[Literal["cpu", "cuda"], typer.Option("--device", help="That trains.")] = "cuda",
    out: Annotated[Path, typer.Option("--out", help="Folder; a stopped run resumes in it.")] = Path(
        "out/detector-weights"
    ),
    workers: Annotated[int, typer.Option("--workers", min=1, help="That render.")] = 2,
) -> None:
    """Make weights of a detector and print hashes and scores."""
    try:
        new = make_weights(variant, out, workers, device)
        for name in _datasets():
            typer.echo(f"{name}: {Dataset(out / name).manifest.dataset_sha256}")
        typer.echo(f"{new}: {hashlib.sha256(new.read_bytes()).hexdigest()}")
        shipped = network_file(f"mobile-{variant}")
        assert shipped is not None
        for line in score_lines(out, {"shipped": shipped, "new": new}):
            typer.echo(line)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    typer.run(main)
