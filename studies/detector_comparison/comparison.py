"""Training, export, timing and scoring of YOLOv8 and our detectors; a stage whose output file exists is skipped."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from datasets_manifest.atomic import takes_lock, write_text_atomic
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from droguekit.benchmark.detection.detection_run import LEAST_SCORE, DetectorPass
from droguekit.benchmark.results.detection_result import write_detections
from nav.detector.detector import Detector
from nav.detector.onnx_cost import network_cost
from nav.detector.onnx_detector import OnnxDetector
from studies.detector_comparison.latency import measure_latency
from studies.detector_comparison.yolo_detector import YoloDetector
from studies.detector_comparison.yolo_training import (
    check_corpus,
    export_corpus,
    training_image_count,
    yolo_environment_variables,
    yolo_python,
)

PEERS = ("yolov8s", "yolov8n")
_SCRIPT = Path(__file__).with_name("yolo_script.py")
_TIMED_PAIRS = 4
# Where it is computed and how long it is timed change nothing that is trained.
_FREE_TO_CHANGE = ("ours", "threads", "rounds", "device", "environment")

Say = Callable[[str], None]


@dataclass(frozen=True)
class ComparisonOptions:
    """What is compared.

    Attributes:
        corpus: dataset to train on.
        test: dataset whose test split is scored; may be the corpus.
        ours: ONNX files of our detectors, trained elsewhere on the same corpus.
        image_passes: through each peer; 0 leaves them untrained, and times them only.
        size_px: width and height of every network's input.
        batch: images in a step of the peers' training.
        threads: of training and timing.
        rounds: of timing.
        device: on which peers are trained, as ultralytics names it.
        seed: of the peers' training.
        environment: folder of the peers' virtual environment.
    """

    corpus: Path
    test: Path
    ours: tuple[Path, ...]
    image_passes: int
    size_px: tuple[int, int]
    batch: int
    threads: int
    rounds: int
    device: str
    seed: int
    environment: Path

    def __post_init__(self) -> None:
        if self.image_passes < 0 or self.batch < 1 or self.threads < 1 or self.rounds < 1:
            raise ValueError(
                "image_passes, batch, threads, rounds: must be positive, got "
                f"{self.image_passes}, {self.batch}, {self.threads}, {self.rounds}"
            )
        if any(side < 32 or side % 32 for side in self.size_px):
            raise ValueError(f"size: must be multiples of 32 px, got {self.size_px[1]}x{self.size_px[0]}")


def compare_peers(order: ComparisonOptions, out: Path, say: Say) -> dict[str, Any]:
    """Run every stage that is not over yet.

    Args:
        order: what to compare.
        out: folder of the comparison.
        say: takes a line about what goes on.

    Returns:
        By detector's name, its cost, times and scores.

    Raises:
        ValueError: a wrong number, corpus or file, or a folder of another comparison or with another run at work in it.
        OSError: the peers' environment cannot be made, a training failed, or a file cannot be written.
    """
    # Whatever is wrong is said before hours of training.
    ours = _our_detectors(order)
    if order.image_passes:
        check_corpus(order.corpus, order.test)
    with _own_folder(order, out):
        return _compare(order, out, ours, say)


def _compare(order: ComparisonOptions, out: Path, ours: Mapping[str, Detector], say: Say) -> dict[str, Any]:
    networks = {name: _peer_network(order, out, name, say) for name in PEERS}
    detectors: dict[str, Detector] = {name: YoloDetector(file, order.threads) for name, file in networks.items()}
    detectors |= ours
    networks |= {file.stem: file for file in order.ours}
    say(f"timing {', '.join(detectors)} in turns, {order.threads} threads")
    rows = {
        name: network_cost(file, order.size_px)._asdict() | times
        for (name, file), times in zip(networks.items(), _latencies(order, detectors), strict=True)
    }
    if order.image_passes:
        scores = _scores(order, out, detectors, say)
        rows = {name: row | scores[name] for name, row in rows.items()}
    told = {name: str(value) for name, value in asdict(order).items()}
    if order.image_passes:
        length = training_length(order.image_passes, training_image_count(order.corpus))
        told["peer_image_passes"] = str(length.image_passes)
    write_text_atomic(
        out / "comparison.json", json.dumps({"schema": 1, "order": told, "detectors": rows}, indent=1) + "\n"
    )
    return rows


def run_script(python: Path, order: Mapping[str, Any], log: Path, variables: Mapping[str, str]) -> None:
    """Have the peers' environment do something; what it says goes to a log.

    Raises:
        OSError: it failed; says its last line and names the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        ended = subprocess.run(
            # -P: a file that lies where the user works must not stand in for a module of ultralytics.
            [str(python), "-P", str(_SCRIPT)],
            input=json.dumps(order),
            text=True,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=dict(variables),
            cwd=log.parent,
            check=False,
        )
    if ended.returncode != 0:
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        raise OSError(f"{log}: ultralytics ended with status {ended.returncode}: {lines[-1] if lines else 'silently'}")


class TrainingLength(NamedTuple):
    """How long ultralytics trains.

    Attributes:
        epochs: number of them.
        fraction: of the images that each takes.
        image_passes: that this makes.
    """

    epochs: int
    fraction: float
    image_passes: int


def training_length(image_passes: int, images: int) -> TrainingLength:
    """What makes nearly so many passes.

    ultralytics trains whole epochs, and a share of the images would be the same ones in every epoch: the passes are
    rounded to whole epochs of all images, and only those of less than one leave images out.

    Raises:
        ValueError: no images.
    """
    if images < 1:
        raise ValueError("corpus: has no images to train on")
    epochs, fraction = max(1, round(image_passes / images)), min(1.0, image_passes / images)
    return TrainingLength(epochs, fraction, epochs * round(fraction * images))


def _our_detectors(order: ComparisonOptions) -> dict[str, Detector]:
    """Ours by name, opened and found countable."""
    detectors: dict[str, Detector] = {}
    for file in order.ours:
        if file.stem in (*PEERS, *detectors):
            raise ValueError(f"--ours: {file}: another detector is named {file.stem!r}; rename the file")
        detectors[file.stem] = OnnxDetector(file, file.stem, order.threads, order.size_px)
        network_cost(file, order.size_px)
    return detectors


@contextmanager
def _own_folder(order: ComparisonOptions, out: Path) -> Iterator[None]:
    """Claim a new folder, or go on in the one of this comparison, if nobody else does."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("a") as lock:
        if not takes_lock(lock):
            raise ValueError(f"{out}: another comparison is at work in it; wait for its end, or name another folder")
        _check_folder(order, out)
        yield


def _check_folder(order: ComparisonOptions, out: Path) -> None:
    """Refuse a folder of another comparison, and write down what a new one is of."""
    settings = {name: str(value) for name, value in asdict(order).items() if name not in _FREE_TO_CHANGE}
    for name, dataset in (("corpus", order.corpus), ("test", order.test)):
        settings[name] = Dataset(dataset).manifest.dataset_sha256
    file = out / "settings.json"
    if file.exists():
        try:
            before = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{file}: is not JSON: {error}") from error
        if not isinstance(before, dict):
            raise ValueError(f"{file}: must hold the settings of a comparison, got {type(before).__name__}")
        differing = sorted(name for name in settings if before.get(name) != settings[name])
        if differing:
            raise ValueError(f"{out}: holds a comparison with another {', '.join(differing)}; name a new folder")
    write_text_atomic(file, json.dumps(settings, indent=1) + "\n")


def _peer_network(order: ComparisonOptions, out: Path, name: str, say: Say) -> Path:
    """A peer's ONNX file, trained and exported where that has not been done."""
    file = (out / f"{name}.onnx").resolve()
    if file.exists():
        return file
    python = yolo_python(order.environment, say)
    folder = (out / name).resolve()
    variables = yolo_environment_variables(out / "ultralytics", order.threads)
    weights = f"{name}.yaml"
    if order.image_passes:
        weights = str(folder / "train" / "weights" / "best.pt")
        over = folder / "trained"
        if not over.exists():
            data = export_corpus(order.corpus, out / "pictures", order.size_px).resolve()
            length = training_length(order.image_passes, training_image_count(order.corpus))
            training = {
                "do": "train",
                "config": f"{name}.yaml",
                "data": str(data),
                "folder": str(folder),
                "epochs": length.epochs,
                "fraction": length.fraction,
                "side_px": max(order.size_px),
                "batch": order.batch,
                "threads": order.threads,
                "device": order.device,
                "seed": order.seed,
            }
            told = f"{length.epochs} epochs, {length.image_passes} image passes"
            say(f"{name}: training, {told}; {folder / 'train.log'}")
            run_script(python, training, folder / "train.log", variables)
            write_text_atomic(over, "")
    say(f"{name}: exporting")
    part = file.with_suffix(".part.onnx")
    export = {"do": "export", "weights": weights, "file": str(part), "size_px": order.size_px}
    run_script(python, export, folder / "export.log", variables)
    part.replace(file)
    return file


def _latencies(order: ComparisonOptions, detectors: Mapping[str, Detector]) -> list[dict[str, Any]]:
    source = BlindDataset(order.test)
    pairs = [source.pair(index).images for index in source.frame_indices[:_TIMED_PAIRS]]
    return [latency._asdict() for latency in measure_latency(detectors, pairs, order.rounds).values()]


def _scores(
    order: ComparisonOptions, out: Path, detectors: Mapping[str, Detector], say: Say
) -> dict[str, dict[str, Any]]:
    """Overall scores by our own benchmark, of the boxes of every detector; those found before stand."""
    files = []
    for name, detector in detectors.items():
        file = out / "detections" / f"{name}.json"
        files.append(file)
        # Our own may have been trained anew under the same name.
        if not file.exists() or name not in PEERS:
            say(f"{name}: looking for the drogue")
            _detect(order.test, detector, file)
    result, page = out / "scores.json", out / "scores.html"
    options = [word for file in files for word in ("--detections", str(file))]
    command = [sys.executable, "-P", "-m", "droguekit.cli.main", "benchmark", str(order.test), *options]
    command += ["--split", "test", "--json", str(result), "--html", str(page)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise OSError(ended.stderr.strip() or f"benchmark ended with status {ended.returncode}")
    say(f"wrote {page}")
    table = json.loads(result.read_text(encoding="utf-8"))["detectors"]
    return {name: {key: table[name]["overall"][key] for key in ("ap", "ap50", "ap75", "recall")} for name in detectors}


def _detect(corpus: Path, detector: Detector, file: Path) -> None:
    looking = DetectorPass(corpus, lambda drogue: detector)
    write_detections(file, looking.boxes(LEAST_SCORE, lambda: None))


def comparison_lines(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """One line a detector; the ratio is of CPU times, round by round, to the first one's."""
    first = next(iter(rows))
    yield (
        f"{'detector':<16} {'parameters':>11} {'GFLOPs':>7} {'wall p50':>9} {'p90':>7} {'p99':>7} {'CPU p50':>9} "
        f"{'CPU / ' + first:>14} {'AP50':>8} {'AP':>8}"
    )
    for name, row in rows.items():
        wall = " ".join(f"{time_ms:{width}.1f}" for time_ms, width in zip(row["wall_ms"], (9, 7, 7), strict=True))
        yield (
            f"{name:<16} {row['parameters']:>11,} {row['gflops_per_image']:7.2f} {wall} {row['cpu_ms'][0]:9.1f} "
            f"{row['ratio']:14.2f} {_share(row.get('ap50')):>8} {_share(row.get('ap')):>8}"
        )
    yield "times in ms for a stereo pair, from full-size images to boxes; GFLOPs of one image"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} %"
