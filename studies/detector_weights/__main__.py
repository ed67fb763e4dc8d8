"""`python -m studies.detector_weights`: makes the weights of a shipped detector anew, and scores them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import typer

from datasets_manifest.storage.reader import Dataset
from droguekit.batch.progress import progress_report
from droguekit.batch.render_dataset import render_dataset
from nav.detector.detector_registry import network_file
from nav.training.training_run import ONNX_FILE
from nav.training.training_state import BEST_FILE
from studies.detector_weights.corpora import PLAIN_GROUNDS, TRAININGS, datasets
from studies.detector_weights.plain_grounds import write_plain_grounds
from studies.detector_weights.public_photographs import TEST_PACKAGES, TRAINING_PACKAGES, fetch_photographs
from studies.droguekit_command import run_droguekit
from studies.world_variety.detection_by_kind import drogue_kind, score_by_kind, scores_side_by_side
from studies.wrong_input import wrong_input_ends


def make_weights(variant: str, out: Path, workers: int, device: str) -> Path:
    """Fetch photographs, render corpora and test sets, and train several times; what is there is not made again.

    Returns:
        The file of the trained network.
    """
    say = typer.echo
    say(f"photographs of {', '.join(TRAINING_PACKAGES + TEST_PACKAGES)}")
    fetch_photographs(out / "photographs", TRAINING_PACKAGES)
    fetch_photographs(out / "test-photographs", TEST_PACKAGES)
    for name, (source, frames) in datasets(variant).items():
        say(f"{name}: {len(frames)} pairs of {source.recipe.name}")
        render_dataset(source, out / name, frames, workers, progress_report())
    log = out / "log.txt"
    say(f"training; {log} tells how far it is")
    photographs, on_grounds = out / "photographs", out / "photographs-and-grounds"
    shutil.rmtree(on_grounds, ignore_errors=True)
    shutil.copytree(photographs, on_grounds)
    write_plain_grounds(on_grounds / "plain-grounds", PLAIN_GROUNDS)
    before: Path | None = None
    for training in TRAININGS[variant]:
        trained = out / f"{variant}-{training.name}"
        corpora = [out / name for name in training.corpora]
        words = ["--out", trained, "--settings", training.settings(variant)]
        words += ["--photographs", on_grounds if training.has_grounds else photographs]
        words += [] if before is None else ["--start-from", before / BEST_FILE]
        run_droguekit("train", *corpora, *words, "--device", device, "--cache", out / "cache", log=log)
        before = trained
    assert before is not None
    return before / ONNX_FILE


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
    with wrong_input_ends("detector_weights"):
        new = make_weights(variant, out, workers, device)
        for name in datasets(variant):
            typer.echo(f"{name}: {Dataset(out / name).manifest.dataset_sha256}")
        typer.echo(f"{new}: {hashlib.sha256(new.read_bytes()).hexdigest()}")
        shipped = network_file(f"mobile-{variant}")
        assert shipped is not None
        for line in score_lines(out, {"shipped": shipped, "new": new}):
            typer.echo(line)


if __name__ == "__main__":
    typer.run(main)
