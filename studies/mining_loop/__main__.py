"""`python -m studies.mining_loop`: trains on as many mined as evenly drawn frames, and compares the worst cells."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.stats import t

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.reader import Dataset
from droguekit.scoring.detection.detection_metrics import Evaluation
from droguekit.scoring.detection.detection_truth import ImageTruth, read_detection_truth
from droguekit.scoring.results.detection_result import DetectedBox, image_id_of, read_detections
from geometry.se3 import Array
from studies.droguekit_command import run_droguekit
from studies.wrong_input import wrong_input_ends

RECIPE = Path(__file__).with_name("loop.toml")
ARMS = ("even", "mined")
EDGES_M = (2.0, 8.0, 16.0, 28.0, 40.0)
_FAMILIES = ("day", "low-sun", "dusk", "haze")


def make_corpora(out: Path, test_pairs: int, workers: int) -> None:
    """Render what is not there yet: the first corpus, an even second one, one to mine in, and one to test on."""
    base = RECIPE.read_text(encoding="utf-8")
    even_test = base
    for family in _FAMILIES:
        even_test = even_test.replace(f'name = "{family}"\nweight = 8', f'name = "{family}"')
    texts = {
        "first": base,
        "even": base.replace("seed = 1\n", "seed = 2\n", 1),
        "trial": base.replace("seed = 1\n", "seed = 3\n", 1).replace("count = 150", "count = 300", 1),
        "test": even_test.replace("seed = 1\n", "seed = 4\n", 1)
        .replace("count = 150\nscenes = 75", f"count = {test_pairs}\nscenes = {test_pairs // 2}", 1)
        .replace("train = 0.9\nval = 0.1\ntest = 0.0", "train = 0.0\nval = 0.0\ntest = 1.0", 1),
    }
    for name, text in texts.items():
        recipe = out / f"{name}.toml"
        write_text_atomic(recipe, text)
        run_droguekit("render", recipe, "--out", out / name, "--workers", workers, log=out / "render.log")


def train_and_detect(
    out: Path, name: str, corpora: Sequence[str], dataset: str, passes: int, seed: int, start: str | None = None
) -> Path:
    """Train on corpora unless that is done, from given weights or from the start, and write the boxes in a dataset.

    Raises:
        ValueError: the folder of the training holds another one.
        OSError: a command failed; names the log.
    """
    folder = out / "trainings" / f"{name}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    made_from = {
        "passes": passes,
        "corpora": [Dataset(out / corpus).manifest.dataset_sha256 for corpus in corpora],
        "pictures": Dataset(out / dataset).manifest.dataset_sha256,
        "weights": None if start is None else _weights_name(start),
    }
    _check_made_from(folder, made_from)
    boxes = folder / f"{dataset}.json"
    if not boxes.is_file():
        words: list[object] = ["--variant", "s", "--image-passes", passes, "--size", "192x256", "--seed", seed]
        words += ["--threads", 1]
        sources = [out / corpus for corpus in corpora]
        if start is not None:
            words += ["--start-from", start]
        log = folder / "train.log"
        run_droguekit("train", *sources, "--out", folder, "--cache", out / "cache", *words, log=log)
        found = folder / "detector.onnx"
        run_droguekit("detect", out / dataset, "--detector", found, "--out", boxes, log=log)
    return boxes


def _weights_name(start: str) -> str:
    """Hash of a file of weights, or the name of shipped ones."""
    file = Path(start)
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else start


def _check_made_from(folder: Path, made_from: dict[str, object]) -> None:
    """Record in an empty folder what its training is made from, and refuse one that holds another training."""
    file = folder / "made-from.json"
    if not file.is_file():
        if any(folder.iterdir()):
            raise ValueError(
                f"{folder}: holds a training without {file.name}, made from unknown data; give another --out"
            )
        write_text_atomic(file, json.dumps(made_from, indent=1) + "\n")
        return
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: is damaged: {error}; give another --out") from error
    held = stored if isinstance(stored, dict) else {}
    if other := [key for key, value in made_from.items() if key not in held or held[key] != value]:
        raise ValueError(f"{folder}: holds a training with other {', '.join(other)}; give another --out")


def detected(out: Path, detector: str, dataset: str) -> Path:
    """Boxes of a shipped detector in a dataset, found unless they are there."""
    boxes = out / f"{dataset}-{detector}.json"
    if not boxes.is_file():
        run_droguekit("detect", out / dataset, "--detector", detector, "--out", boxes, log=out / "mine.log")
    return boxes


def cell_scores(dataset: Path, boxes: Path) -> dict[str, float]:
    """AP50 in each cell of family and distance, in percent; empty frames of the family count in each of its cells."""
    truth = read_detection_truth(dataset)
    evaluation = Evaluation(truth.images, read_boxes(truth.images, boxes))
    scores = {}
    for family in _FAMILIES:
        for low_m, high_m in pairwise(EDGES_M):
            inside = [
                image
                for image in truth.images
                if image.family == family and (image.distance_m is None or low_m <= image.distance_m < high_m)
            ]
            ap50 = evaluation.average_precision(inside).ap50
            if ap50 is not None:
                scores[f"{family}, {low_m:g} to {high_m:g} m"] = 100.0 * ap50
    return scores


def read_boxes(images: Sequence[ImageTruth], boxes: Path) -> list[DetectedBox]:
    """Boxes of a file, in images of which the truth is known."""
    return read_detections(boxes, frozenset(image_id_of(image.frame_index, image.eye) for image in images))


def table(scores: dict[str, list[dict[str, float]]], whole: dict[str, list[float]]) -> list[str]:
    """Means over seeds by cell, the worst cell of the even arm first, and the gain there with its interval."""
    cells = list(scores["even"][0])
    mean = {arm: {cell: float(np.mean([each[cell] for each in scores[arm]])) for cell in cells} for arm in ARMS}
    cells.sort(key=lambda cell: mean["even"][cell])
    worst = cells[0]
    lines = ["| cell | even, AP50 by seed | mined, AP50 by seed | gain |", "|---|---|---|---|"]
    for cell in cells:
        by_seed = {arm: ", ".join(f"{each[cell]:.1f}" for each in scores[arm]) for arm in ARMS}
        gain = mean["mined"][cell] - mean["even"][cell]
        lines.append(f"| {cell} | {by_seed['even']} | {by_seed['mined']} | {gain:+.1f} |")
    by_seed = {arm: ", ".join(f"{value:.1f}" for value in whole[arm]) for arm in ARMS}
    gain = float(np.mean(whole["mined"]) - np.mean(whole["even"]))
    lines.append(f"| all | {by_seed['even']} | {by_seed['mined']} | {gain:+.1f} |")
    for what, arms in (
        (f"the worst cell, {worst}", {arm: [each[worst] for each in scores[arm]] for arm in ARMS}),
        ("each training's own worst cell", {arm: [min(each.values()) for each in scores[arm]] for arm in ARMS}),
    ):
        differences = np.subtract(arms["mined"], arms["even"])
        lines.append(f"gain in {what}: {differences.mean():+.1f}{_interval(differences)}")
    return lines


def _interval(differences: Array) -> str:
    count = len(differences)
    if count < 2:
        return ""
    half = float(t.ppf(0.975, count - 1)) * differences.std(ddof=1) / np.sqrt(count)
    return f", 95 % interval {differences.mean() - half:+.1f} to {differences.mean() + half:+.1f}"


def main(
    out: Annotated[
        Path,
        typer.Option("--out", help="Folder; what is found there is not made again, and must be of the same options."),
    ] = Path("out/mining-loop"),
    image_passes: Annotated[int, typer.Option("--image-passes", min=1, help="Of each training.")] = 1000,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Trainings of each arm.")] = 3,
    further_passes: Annotated[
        int | None, typer.Option("--further-passes", min=1, help="Train the first network on by so many, both ways.")
    ] = None,
    start_from: Annotated[
        str | None, typer.Option("--start-from", help="Mine with these weights, and train them on, both ways.")
    ] = None,
    kept: Annotated[float, typer.Option("--kept", help="As of `droguekit mine`.")] = 0.3,
    test_pairs: Annotated[int, typer.Option("--test-pairs", min=2, help="Pairs of the test set.")] = 600,
    workers: Annotated[int, typer.Option("--workers", min=1, help="That render.")] = 1,
) -> None:
    """Render, train, detect, mine, render what was asked for, train both ways, and print the table."""
    with wrong_input_ends("mining_loop"):
        if start_from is not None and further_passes is not None:
            raise ValueError("--start-from, --further-passes: give one of them; each says what to train on from")
        out.mkdir(parents=True, exist_ok=True)
        make_corpora(out, test_pairs, workers)
        name = f"mined-{round(100 * kept)}" if start_from is None else f"mined-{round(100 * kept)}-{start_from}"
        arms = {"even": "even", "mined": name}
        mined, log = out / f"{name}.toml", out / "mine.log"
        if start_from is None:
            trial = train_and_detect(out, "first", ["first"], "trial", image_passes, 0)
        else:
            trial = detected(out, start_from, "trial")
        run_droguekit(
            "mine", out / "trial", "--detections", trial, "--kept", kept, "--count", 150, "--out", mined, log=log
        )
        # As many scenes as the even corpus has: scenes teach more than pairs of one scene.
        asked = re.sub(r"(?m)^scenes = \d+", "scenes = 75", mined.read_text(encoding="utf-8"))
        write_text_atomic(mined, asked)
        run_droguekit("render", mined, "--out", out / name, "--workers", workers, log=out / "render.log")
        scores: dict[str, list[dict[str, float]]] = {arm: [] for arm in ARMS}
        whole: dict[str, list[float]] = {arm: [] for arm in ARMS}
        truth = read_detection_truth(out / "test")
        for seed in range(1, seeds + 1):
            for arm, corpus in arms.items():
                name, passes, start = corpus, image_passes, None
                if start_from is not None:
                    name, start = f"{corpus}-from-{start_from}", start_from
                elif further_passes is not None:
                    name, passes = f"{corpus}-further", further_passes
                    start = str(trial.with_name("best.pt"))
                boxes = train_and_detect(out, name, ["first", corpus], "test", passes, seed, start)
                scores[arm].append(cell_scores(out / "test", boxes))
                evaluation = Evaluation(truth.images, read_boxes(truth.images, boxes))
                ap50 = evaluation.average_precision(truth.images).ap50
                whole[arm].append(100.0 * (ap50 or 0.0))
        if start_from is not None:
            before = cell_scores(out / "test", detected(out, start_from, "test"))
            typer.echo(f"{start_from} as it is: " + ", ".join(f"{cell} {ap50:.1f}" for cell, ap50 in before.items()))
        write_text_atomic(out / "scores.json", json.dumps({"cells": scores, "all": whole}, indent=1) + "\n")
    typer.echo("\n".join(table(scores, whole)))


if __name__ == "__main__":
    typer.run(main)
