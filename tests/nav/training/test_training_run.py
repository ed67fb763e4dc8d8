from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from datasets_manifest.storage.manifest import SplitName
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import ViewRecord
from droguekit.batch.progress import PlainProgress
from droguekit.scoring.detection.detector_runner import DetectorRunner
from droguekit.scoring.results.detection_result import image_id_of
from geometry.stereo import EYES
from nav.detector.input_image import network_input
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.onnx_detector import OnnxDetector
from nav.training.augmentation import Boxes
from nav.training.corpus import Corpus, open_corpus
from nav.training.evaluation import (
    DEFAULT_THRESHOLD,
    Predictions,
    Search,
    ValidationScores,
    average_precision,
    best_threshold,
    detect_split,
    measure_batch_statistics,
    predict,
    to_tensor,
    whole_image,
)
from nav.training.trainer import Batch, BatchMaker, Trainer, is_validation_due
from nav.training.training_run import TrainingResult, check_training, train
from nav.training.training_settings import build_settings
from nav.training.training_state import (
    BEST_FILE,
    CHECKPOINT_FILE,
    ComputeDevice,
    TrainingState,
    limit_threads,
    load_checkpoint,
    new_network,
    new_state,
    open_compute_device,
    read_starting_weights,
    restore_state,
)
from tests.support.small_datasets import render_toy

# One thread and float32: the same sums in the same order, whoever else uses the machine.
SMALL = {
    "variant": "s",
    "size_px": (96, 128),
    "batch_images": 4,
    "warmup_fraction": 0.1,
    "precision": "float32",
    "threads": 1,
}


def run(dataset: Path, out: Path, **changes: Any) -> tuple[TrainingResult, str]:
    told = io.StringIO()
    return train([dataset], out, build_settings(None, {**SMALL, **changes}), PlainProgress(told)), told.getvalue()


def step_losses(out: Path) -> list[float]:
    return [float(row["loss"]) for row in csv.DictReader((out / "losses.csv").open())]


# Killed in the middle of an epoch, after steps that no checkpoint has.
KILLED = """
import io, os, signal, sys
from pathlib import Path
from droguekit.batch.progress import PlainProgress
from nav.training.training_settings import TrainingSettings
from nav.training.training_run import train

calls = 0
def kill():
    global calls
    calls += 1
    if calls == KILLED_AT:
        os.kill(os.getpid(), signal.SIGKILL)
    return False

if __name__ == "__main__":
    settings = TrainingSettings.model_validate_json(sys.argv[3])
    train([Path(sys.argv[1])], Path(sys.argv[2]), settings, PlainProgress(io.StringIO()), should_stop=kill)
"""


def test_a_killed_training_resumes_with_the_same_losses(split_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(None, {**SMALL, "image_passes": 16})
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    run(split_dataset, whole, image_passes=16)
    # Asked after each of 8 pairs that are decoded, then in every step; two steps are an epoch of 4 pairs.
    script = KILLED.replace("KILLED_AT", "11")
    command = [sys.executable, "-c", script, str(split_dataset), str(killed), settings.model_dump_json()]
    died = subprocess.run(command, capture_output=True, text=True, check=False)
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert not (killed / "detector.onnx").exists()
    done = len(step_losses(killed))
    assert 0 < done < settings.steps
    _, told = run(split_dataset, killed, image_passes=16)
    assert f"resumed after {4 * done}" in told
    # Equal sums in equal order; what is left is how another process's memory happens to be aligned.
    np.testing.assert_allclose(step_losses(killed), step_losses(whole), rtol=1e-4)
    result, expected = (json.loads((out / "result.json").read_text()) for out in (killed, whole))
    assert result["settings"] == expected["settings"] and result["datasets"] == expected["datasets"]
    rows, rows_expected = (list(csv.DictReader((out / "history.csv").open())) for out in (killed, whole))
    assert [row["image_passes"] for row in rows] == [row["image_passes"] for row in rows_expected]


def test_a_training_stops_when_told_and_other_settings_are_refused(split_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(None, {**SMALL, "image_passes": 16})
    told = io.StringIO()
    with pytest.raises(KeyboardInterrupt):
        # After the eight pairs that are decoded it is asked once a step.
        train([split_dataset], tmp_path, settings, PlainProgress(told), tmp_path / "cache", Calls(11))
    assert "stopped after 12 images; the state is saved" in told.getvalue()
    assert len(step_losses(tmp_path)) == 3
    assert load_checkpoint(tmp_path / CHECKPOINT_FILE)["step"] == 3
    for changes, keys in (({"learning_rate": 0.5, "mosaic": False}, "mosaic, learning_rate"), ({"seed": 3}, "seed")):
        other = settings.model_copy(update=changes)
        with pytest.raises(ValueError, match=rf"checkpoint\.pt: belongs to a training that differs in {keys};"):
            train([split_dataset], tmp_path, other, PlainProgress(told))
    # Where and with how many workers it computes may change.
    elsewhere = settings.model_copy(update={"loader_workers": 2, "checkpoint_minutes": 1.0, "licence": "MIT"})
    train([split_dataset], tmp_path, elsewhere, PlainProgress(told))
    assert len(step_losses(tmp_path)) == settings.steps


@pytest.mark.parametrize("final_size_px", [None, (480, 640)])
def test_a_long_training_is_validated_twenty_times_at_most(final_size_px: tuple[int, int] | None) -> None:
    changes = {"size_px": (320, 416), "final_size_px": final_size_px, "image_passes": 8 * 1000}
    settings = build_settings(None, changes)
    last, found = 0, []
    for epoch in range(1, 501):
        if is_validation_due(settings, 2 * epoch, epoch, last):
            last = 2 * epoch
            found.append(last)
    assert 10 <= len(found) <= 20 and found[-1] == 1000
    # Of a short one every epoch, before the final size every third.
    short = build_settings(None, changes | {"image_passes": 8 * 12})
    due = [epoch for epoch in range(1, 7) if is_validation_due(short, 2 * epoch, epoch, 2 * epoch - 2)]
    assert due == ([1, 2, 3, 4, 5, 6] if final_size_px is None else [3, 4, 5, 6])


def test_without_a_drogue_to_validate_with_only_the_end_is_validated(
    toy_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, validate = [], Trainer._validate

    def counted(trainer: Trainer, state: TrainingState, size_px: tuple[int, int]) -> ValidationScores | None:
        done.append(state.step)
        return validate(trainer, state, size_px)

    monkeypatch.setattr(Trainer, "_validate", counted)
    # An epoch of 80 images and a step of another.
    run(toy_dataset, tmp_path, image_passes=84)
    assert done == [21]


def test_of_equal_scores_the_later_weights_are_exported(
    split_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Short trainings find nothing in any validation; their first weights have learned least."""
    monkeypatch.setattr(Trainer, "_validate", lambda *_: ValidationScores(0.0, 0.0, 0.0, 0.0))
    result, told = run(split_dataset, tmp_path, image_passes=16)
    assert told.count("val AP50") == 2 and result.best_step == 4


def test_a_process_that_is_killed_ends_the_training_in_one_line(split_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(None, {**SMALL, "image_passes": 4000, "loader_workers": 2})

    def kill_one() -> bool:
        for child in multiprocessing.active_children():
            assert child.pid is not None
            os.kill(child.pid, signal.SIGKILL)
            break
        return False

    with pytest.raises(OSError, match=r"^loader_workers: a process that prepares images was ended.*fewer than 2$"):
        train([split_dataset], tmp_path, settings, PlainProgress(io.StringIO()), should_stop=kill_one)


class BreakingBatchMaker(BatchMaker):
    """A batch maker whose processes lose their connections in the third batch, and end a while later."""

    is_broken = multiprocessing.get_context("fork").Event()

    def batch(self, step: int) -> Batch:
        if step < 4:
            return super().batch(step)
        time.sleep(0.3)  # until the batches before are on their way
        os.closerange(3, 1 << 16)
        self.is_broken.set()
        time.sleep(0.3)
        os._exit(1)


def test_a_process_whose_connections_close_before_it_ends_is_told_as_ended(split_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(None, {**SMALL, "image_passes": 4000, "loader_workers": 2})
    corpus = open_corpus([split_dataset], tmp_path, settings.size_px, 1, PlainProgress(io.StringIO()))
    maker = BreakingBatchMaker(corpus, settings)
    batches = maker.batches(range(10), 2)
    next(batches)
    assert maker.is_broken.wait(30)
    with pytest.raises(RuntimeError, match="DataLoader worker"):
        list(batches)
    # Nothing is raised by what ends after that.
    for child in multiprocessing.active_children():
        child.join()


class Calls:
    """Returns True from the n-th call on."""

    def __init__(self, count: int) -> None:
        self.left = count

    def __call__(self) -> bool:
        self.left -= 1
        return self.left <= 0


def test_the_files_of_a_training(split_dataset: Path, tmp_path: Path) -> None:
    changes = {"image_passes": 16, "views": "one", "attention": "se", "fusion": "concat", "licence": "CC-BY-4.0"}
    result, told = run(split_dataset, tmp_path, **changes)
    assert result.validation is not None and result.test is not None
    assert told.count("val AP50") == 2 and "left" in told
    metadata = {entry.key: entry.value for entry in onnx.load(result.file).metadata_props}
    stated = ModelMetadata.from_json(metadata[METADATA_KEY])
    manifest = json.loads((split_dataset / "manifest.json").read_text())
    assert stated.licence == "CC-BY-4.0" and stated.manifest_sha256 == manifest["manifest_sha256"]
    assert stated.input_size_px == (128, 96)
    assert stated.network == {"variant": "s", "attention": "se", "fusion": "concat"}
    assert stated.training == json.loads((tmp_path / "result.json").read_text())
    assert stated.training["image_passes"] == 16
    assert {each.name for each in tmp_path.iterdir()} >= {
        "checkpoint.pt", "best.pt", "detector.onnx", "last.onnx", "history.csv", "losses.csv", "settings.json",
        "tensorboard",
    }  # fmt: skip
    # A finished training that is asked for again only evaluates and exports.
    again, told = run(split_dataset, tmp_path, **changes)
    assert again == result and "epoch" not in told
    # It can be stopped while it evaluates, and leaves no file that is not.
    result.file.unlink()
    settings = build_settings(None, {**SMALL, **changes})
    with pytest.raises(KeyboardInterrupt):
        train([split_dataset], tmp_path, settings, PlainProgress(io.StringIO()), should_stop=lambda: True)
    assert not result.file.exists()
    (tmp_path / BEST_FILE).unlink()
    with pytest.raises(ValueError, match=r"best\.pt: is missing"):
        run(split_dataset, tmp_path, **changes)


def test_a_training_is_scored_by_what_its_file_finds_in_the_pictures_as_they_were_taken(
    split_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    searched: list[tuple[SplitName, float, Predictions]] = []

    def watched(detector: OnnxDetector, corpus: Corpus, split: SplitName, *rest: Any) -> Predictions:
        found = detect_split(detector, corpus, split, *rest)
        searched.append((split, detector.metadata.score_threshold, found))
        return found

    monkeypatch.setattr("nav.training.training_run.detect_split", watched)
    # Drogues of some 20 px in the input are uncertain, and looked at again: the pictures are 3.3 times as large.
    changes = {**SMALL, "size_px": (96, 96), "image_passes": 4, "learning_rate": 1e-9, "small_below_px": 80.0}
    settings, start = build_settings(None, changes, {"variant": "s"}), read_starting_weights("mobile-s")
    result = train([split_dataset], tmp_path, settings, PlainProgress(io.StringIO()), start=start)
    detector, threshold = OnnxDetector(result.file), result.score_threshold
    assert (detector.metadata.score_threshold, detector.metadata.small_below_px) == (threshold, 80.0)
    assert threshold != DEFAULT_THRESHOLD
    used = [("val", DEFAULT_THRESHOLD), ("val", threshold), ("test", threshold)]
    assert [(split, of_detector) for split, of_detector, _ in searched] == used
    for (split, _, seen), reached in zip(searched[1:], (result.validation, result.test), strict=True):
        truth, found = boxes_in_use(detector, Dataset(split_dataset), split)
        for (_, scores), (_, wanted) in zip(seen.found, found, strict=True):
            np.testing.assert_array_equal(scores, wanted)
        # Overlaps do not depend on the size at which they are computed, but for their last bits.
        assert reached == average_precision(truth, found)
    first = searched[0][2]
    assert threshold == best_threshold(first.truth, first.found, DEFAULT_THRESHOLD)
    assert (tmp_path / "last.onnx").read_bytes() == result.file.read_bytes()


def boxes_in_use(
    detector: OnnxDetector, dataset: Dataset, split: SplitName
) -> tuple[list[Boxes], list[tuple[Boxes, Boxes]]]:
    """True boxes of each image of a split, and those that `droguekit detect` writes, from corners. [px]"""
    truth, found = [], []
    frames = [entry.frame_index for entry in dataset.manifest.frames if entry.split == split]
    written = list(DetectorRunner(dataset.path, lambda _: detector, frames).boxes(0.01, lambda: None))
    for frame in frames:
        for eye in EYES:
            view: ViewRecord = getattr(dataset.record(frame).views, eye)
            own = [] if view.box_visible_xywh_px is None else [view.box_visible_xywh_px]
            truth.append(np.reshape(own, (-1, 4)) + np.array([0.5, 0.5, 0.0, 0.0]))
            some = [box for box in written if box.image_id == image_id_of(frame, eye)]
            boxes = np.reshape([box.box_xywh for box in some], (-1, 4))
            found.append((boxes, np.array([box.score for box in some])))
    return truth, found


@pytest.mark.slow
def test_a_training_in_bf16_exports_what_float32_computes(split_dataset: Path, tmp_path: Path) -> None:
    result, _ = run(split_dataset, tmp_path, image_passes=4, precision="bf16")
    settings = build_settings(None, SMALL)
    corpus = open_corpus([split_dataset], tmp_path / "cache", settings.size_px, 1, PlainProgress(io.StringIO()))
    network, exact = new_network(settings).eval(), ComputeDevice(torch.device("cpu"), bf16=False)
    network.load_state_dict(load_checkpoint(tmp_path / BEST_FILE)["network"])
    measure_batch_statistics(network, corpus, settings.size_px, exact)
    image, _ = whole_image(corpus, 0, 0, settings.size_px)
    with torch.no_grad():
        expected = network(to_tensor(image[None], exact))
    session = onnxruntime.InferenceSession(result.file.read_bytes(), providers=["CPUExecutionProvider"])
    for got, reference in zip(session.run(None, {"images": network_input([image])}), expected, strict=True):
        # Float32 summed in another order; statistics measured in bfloat16 are off by hundredths.
        np.testing.assert_allclose(got, reference, atol=2e-4 * max(1.0, float(reference.abs().max())))


@pytest.mark.slow
def test_several_datasets_have_no_hash_of_one(split_dataset: Path, tmp_path: Path) -> None:
    second = render_toy(tmp_path / "second", seed=6, frames={"count": 2, "scenes": 1, "empty_fraction": None})
    changes = {"image_passes": 4, "final_size_px": (192, 256), "final_fraction": 0.5}
    settings, out = build_settings(None, {**SMALL, **changes}), tmp_path / "out"
    result = train([split_dataset, second], out, settings, PlainProgress(io.StringIO()))
    (entry,) = onnx.load(result.file).metadata_props
    stated = ModelMetadata.from_json(entry.value)
    assert stated.manifest_sha256 == "" and stated.licence == ""
    assert len({each["manifest_sha256"] for each in stated.training["datasets"]}) == 2


def test_errors_of_a_training_are_found_before_there_is_data(split_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(None, {**SMALL, "image_passes": 4})
    check_training(tmp_path / "none", settings)
    assert not (tmp_path / "none").exists()
    out = tmp_path / "out"
    run(split_dataset, out, image_passes=4)
    check_training(out, settings)
    with pytest.raises(ValueError, match="differs in seed;"):
        check_training(out, settings.model_copy(update={"seed": 3}))
    with (out / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="another training is running"):
            check_training(out, settings)
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="file: is a file"):
        check_training(tmp_path / "file", settings)


@pytest.mark.slow
def test_a_training_starts_from_the_weights_of_another(split_dataset: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    run(split_dataset, first, image_passes=4)
    start = read_starting_weights(str(first / BEST_FILE))
    # A rate at which nothing is learned leaves the other's weights; those of the seed are far from them.
    settings = build_settings(None, {**SMALL, "image_passes": 4, "learning_rate": 1e-12, "seed": 5})
    told = PlainProgress(io.StringIO())
    result = train([split_dataset], second, settings, told, start=start)
    found, random = read_starting_weights(str(second / CHECKPOINT_FILE)).values, new_network(settings).state_dict()
    for name in (name for name, value in start.values.items() if value.ndim == 4):
        torch.testing.assert_close(found[name], start.values[name], rtol=0, atol=1e-6)
        assert (found[name] - random[name]).abs().max() > 1e-3
    metadata = {entry.key: entry.value for entry in onnx.load(result.file).metadata_props}
    digest = hashlib.sha256((first / BEST_FILE).read_bytes()).hexdigest()
    assert ModelMetadata.from_json(metadata[METADATA_KEY]).training["settings"]["start_sha256"] == digest
    with pytest.raises(ValueError, match=r"checkpoint\.pt: belongs to a training that differs in start_sha256;"):
        train([split_dataset], second, settings, told)
    with pytest.raises(ValueError, match=r"start_sha256: 0{64} is not that of the weights given"):
        train([split_dataset], second, settings.model_copy(update={"start_sha256": "0" * 64}), told, start=start)
    with pytest.raises(ValueError, match=r"best\.pt: holds weights of another network;"):
        check_training(tmp_path / "third", settings.model_copy(update={"variant": "l"}), start)


def test_a_device_that_is_not_available_is_refused(split_dataset: Path, tmp_path: Path) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(ValueError, match="device: torch finds no CUDA device"):
        run(split_dataset, tmp_path, device="cuda")


def test_a_folder_in_use_is_refused(split_dataset: Path, tmp_path: Path) -> None:
    with (tmp_path / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="another training is running"):
            run(split_dataset, tmp_path)


# 350 steps, without images put together: a network that is to know 80 images needs no others.
TOY = {"image_passes": 1400, "warmup_fraction": 0.1143, "learning_rate": 0.005, "mosaic": False, "ema_decay": 0.97}


@pytest.mark.slow
def test_forty_pairs_are_memorised(toy_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(None, {**SMALL, **TOY})
    train([toy_dataset], tmp_path, settings, PlainProgress(io.StringIO()))
    corpus = open_corpus([toy_dataset], tmp_path / "cache", settings.size_px, 1, PlainProgress(io.StringIO()))
    compute = open_compute_device(settings)
    state = new_state(new_network(settings), settings, compute)
    restore_state(tmp_path, state, settings, corpus.datasets)
    with limit_threads(1):
        search = Search(settings.size_px, 8, settings.large_from_px)
        predictions = predict(state.average.network, corpus, "train", search, compute)
    reached = average_precision(predictions.truth, predictions.found)
    assert reached is not None and reached.ap50 >= 0.95


# Enough memory for the images of a batch, but not for what the network makes of them.
STARVED = """
import io, resource, sys
from pathlib import Path
from droguekit.batch.progress import PlainProgress
from nav.training.training_settings import TrainingSettings
from nav.training.training_run import train

settings = TrainingSettings.model_validate_json(sys.argv[3])
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + 2**31
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
try:
    train([Path(sys.argv[1])], Path(sys.argv[2]), settings, PlainProgress(io.StringIO()))
except ValueError as error:
    print(error)
"""


@pytest.mark.slow
def test_lack_of_memory_is_told_in_one_line(split_dataset: Path, tmp_path: Path) -> None:
    settings = build_settings(
        None, {**SMALL, "batch_images": 1024, "size_px": (256, 320), "image_passes": 2048, "mosaic": False}
    )
    command = [sys.executable, "-c", STARVED, str(split_dataset), str(tmp_path / "out"), settings.model_dump_json()]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    told = "batch_images: 1024 images of 256x320 need more memory than cpu has left; train with fewer or smaller ones"
    assert ended.stdout.strip() == f"{told}, into another folder"
