"""Short trainings of the small network, whose scores are compared with each other."""

from __future__ import annotations

import json
from pathlib import Path

from datasets_manifest.storage.reader import Dataset
from nav.training.training_run import LAST_ONNX_FILE, ONNX_FILE, RESULT_FILE
from studies.droguekit_command import run_droguekit


def train_briefly(corpus: Path, out: Path, cache: Path, image_passes: int, seed: int) -> Path:
    """Train `s` from random weights at 320 x 416 px on one thread, unless that is done; a stopped training goes on.

    Args:
        corpus: dataset to learn from.
        out: the training's folder; its log stands beside it.
        cache: of the corpora's images.
        image_passes: number of images that the network sees.
        seed: of the training.

    Returns:
        The file of the trained network.

    Raises:
        ValueError: the folder holds a finished training of other pictures, passes or seed.
        OSError: the training failed; names the log.
    """
    words: list[object] = ["--variant", "s", "--size", "320x416", "--image-passes", image_passes, "--seed", seed]
    # The last file that a training writes.
    if (out / LAST_ONNX_FILE).is_file():
        _check_finished(corpus, out, image_passes, seed)
    else:
        where: list[object] = ["--out", out, "--cache", cache]
        run_droguekit("train", corpus, *where, "--threads", 1, *words, log=out.with_suffix(".log"))
    return out / ONNX_FILE


def _check_finished(corpus: Path, out: Path, image_passes: int, seed: int) -> None:
    result = json.loads((out / RESULT_FILE).read_text(encoding="utf-8"))
    settings = result["settings"]
    trained = [each["dataset_sha256"] for each in result["datasets"]], settings["image_passes"], settings["seed"]
    if trained != ([Dataset(corpus).manifest.dataset_sha256], image_passes, seed):
        raise ValueError(f"{out}: holds a training of other pictures, passes or seed; give another folder")
