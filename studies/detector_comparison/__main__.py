"""`python -m studies.detector_comparison`: compares our detectors with those of other projects on the same corpus.

Trains, exports, times and scores the detectors; a stage whose output file exists is skipped.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from datasets_manifest.atomic import try_lock, write_text_atomic
from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from droguekit.scoring.detection.detector_runner import LEAST_SCORE, DetectorRunner
from droguekit.scoring.results.detection_result import write_detections
from nav.detector.detector import Detector
from nav.detector.onnx_cost import network_cost
from nav.detector.onnx_detector import OnnxDetector
from studies.detector_comparison.accuracy_plot import write_accuracy_plot
from studies.detector_comparison.latency import measure_latency
from studies.detector_comparison.options import (
    CorpusOption,
    DeviceOption,
    PassesOption,
    SeedOption,
    SizeOption,
    TestOption,
    ThreadsOption,
    input_size_px,
    print_status,
)
from studies.detector_comparison.peer_corpus import (
    check_corpus,
    export_corpus,
    training_image_count,
    training_length,
)
from studies.detector_comparison.peer_environment import peer_python, run_script, script_variables
from studies.detector_comparison.peers import PEERS, ULTRALYTICS_STEP_IMAGES
from studies.wrong_input import wrong_input_ends

_TIMED_PAIRS = 4
# Options that may change when a comparison is resumed, because they do not change what is trained.
_FREE_TO_CHANGE = ("ours", "peers", "threads", "rounds", "device", "environment")
_EXAMPLES = """Examples:

  python -m studies.detector_comparison --corpus data/detector-small --ours out/detector/detector.onnx

  python -m studies.detector_comparison --corpus data/detector-train --test data/detector-test --image-passes 8000

  python -m studies.detector_comparison --corpus data/demo --image-passes 0"""

Say = Callable[[str], None]


@dataclass(frozen=True)
class ComparisonOptions:
    """Options of a comparison.

    Attributes:
        corpus: dataset to train on.
        test: dataset whose test split is scored; may be the corpus.
        ours: ONNX files of our detectors, trained before on the same corpus.
        image_passes: of each peer's training; with 0 peers are not trained, only timed.
        size_px: width and height of every network's input.
        batch: images that go through a peer at once in its training.
        step_images: images in a step of the optimizer of ultralytics' networks.
        threads: of training and timing.
        rounds: of timing.
        device: on which the peers are trained, as their projects name it.
        seed: of the peers' training.
        environment: folder of the peers' virtual environment.
        peers: which of `PEERS`.
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
    peers: tuple[str, ...] = tuple(PEERS)
    step_images: int = ULTRALYTICS_STEP_IMAGES

    def __post_init__(self) -> None:
        if self.image_passes < 0 or self.batch < 1 or self.threads < 1 or self.rounds < 1:
            raise ValueError(
                "image_passes, batch, threads, rounds: must be positive, got "
                f"{self.image_passes}, {self.batch}, {self.threads}, {self.rounds}"
            )
        if self.step_images < 1:
            raise ValueError(f"step_images: must be at least 1, got {self.step_images}")
        if unknown := [name for name in self.peers if name not in PEERS]:
            raise ValueError(f"--peer: must be one of {', '.join(PEERS)}, got {', '.join(unknown)}")
        if any(side < 32 or side % 32 for side in self.size_px):
            raise ValueError(f"size: must be multiples of 32 px, got {self.size_px[1]}x{self.size_px[0]}")
        for name in self.peers:
            least_px = PEERS[name].least_side_px
            if max(PEERS[name].input_size_px(self.size_px)) < least_px:
                raise ValueError(f"size: {name} needs {least_px} px, got {self.size_px[1]}x{self.size_px[0]}")


def compare_peers(options: ComparisonOptions, out: Path, say: Say) -> dict[str, Any]:
    """Run every stage whose output does not exist yet.

    Args:
        options: of the comparison.
        out: folder of the comparison.
        say: receives lines about the progress.

    Returns:
        Cost, times and scores by the detector's name.

    Raises:
        ValueError: a wrong option, corpus or file, or a folder of another comparison or one that another run uses.
        OSError: the peers' environment cannot be made, a training failed, or a file cannot be written.
    """
    # All inputs are checked before hours of training.
    ours = _our_detectors(options)
    if options.image_passes:
        check_corpus(options.corpus, options.test)
    with _own_folder(options, out):
        return _compare(options, out, ours, say)


def _compare(options: ComparisonOptions, out: Path, ours: Mapping[str, Detector], say: Say) -> dict[str, Any]:
    networks = {name: _peer_network(options, out, name, say) for name in options.peers}
    peers = {name: PEERS[name].open_detector(file, options.threads) for name, file in networks.items()}
    detectors: dict[str, Detector] = {**peers, **ours}
    networks |= {file.stem: file for file in options.ours}
    sizes_px = {name: peer.input_size_px for name, peer in peers.items()}
    say(f"timing {', '.join(detectors)} in turns, {options.threads} threads")
    rows = {
        name: network_cost(file, sizes_px.get(name, options.size_px))._asdict() | times
        for (name, file), times in zip(networks.items(), _latencies(options, detectors), strict=True)
    }
    if options.image_passes:
        scores = _scores(options, out, detectors, say)
        rows = {name: row | scores[name] for name, row in rows.items()}
    recorded = {name: str(value) for name, value in asdict(options).items()}
    if options.image_passes:
        length = training_length(options.image_passes, training_image_count(options.corpus))
        recorded["peer_image_passes"] = str(length.image_passes)
    write_text_atomic(
        out / "comparison.json", json.dumps({"schema": 1, "order": recorded, "detectors": rows}, indent=1) + "\n"
    )
    # Without a drogue in the test split there is nothing to draw.
    if options.image_passes and all(row["ap"] is not None for row in rows.values()):
        write_accuracy_plot(rows, PEERS, out / "accuracy.png")
        say(f"wrote {out / 'accuracy.png'}")
    return rows


def _our_detectors(options: ComparisonOptions) -> dict[str, Detector]:
    """Our detectors by name, opened, and their operations counted once to see that they can be."""
    detectors: dict[str, Detector] = {}
    for file in options.ours:
        if file.stem in (*PEERS, *detectors):
            raise ValueError(f"--ours: {file}: another detector is named {file.stem!r}; rename the file")
        detectors[file.stem] = OnnxDetector(file, file.stem, options.threads, options.size_px)
        network_cost(file, options.size_px)
    return detectors


@contextmanager
def _own_folder(options: ComparisonOptions, out: Path) -> Iterator[None]:
    """Lock a new folder or that of this comparison, unless another run uses it."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / ".lock").open("a") as lock:
        if not try_lock(lock):
            raise ValueError(f"{out}: another comparison is running in it; wait for its end, or name another folder")
        _check_folder(options, out)
        yield


def _check_folder(options: ComparisonOptions, out: Path) -> None:
    """Refuse the folder of another comparison; record the options in a new one."""
    settings = {name: str(value) for name, value in asdict(options).items() if name not in _FREE_TO_CHANGE}
    for name, dataset in (("corpus", options.corpus), ("test", options.test)):
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


def _peer_network(options: ComparisonOptions, out: Path, name: str, say: Say) -> Path:
    """A peer's ONNX file; the peer is trained and exported where that has not been done."""
    file = (out / f"{name}.onnx").resolve()
    if file.exists():
        return file
    peer = PEERS[name]
    python = peer_python(options.environment, say)
    folder = (out / name).resolve()
    variables = script_variables(out / "ultralytics", options.threads)
    weights = None
    if options.image_passes:
        # Both projects choose the best epoch by the split `val`, and write it there.
        weights = str(folder / "train" / "weights" / "best.pt")
        done = folder / "trained"
        if not done.exists():
            training = _peer_training(options, out, name, folder, say)
            run_script(python, peer.script, training, folder / "train.log", variables)
            write_text_atomic(done, "")
    say(f"{name}: exporting")
    part = file.with_suffix(".part.onnx")
    size_px = peer.input_size_px(options.size_px)
    export = {"do": "export", "config": peer.config, "weights": weights, "file": str(part), "size_px": size_px}
    run_script(python, peer.script, export, folder / "export.log", variables)
    part.replace(file)
    return file


def _peer_training(options: ComparisonOptions, out: Path, name: str, folder: Path, say: Say) -> dict[str, Any]:
    """The task by which a script trains a peer, with the corpus exported for it."""
    size_px = PEERS[name].input_size_px(options.size_px)
    pictures = "square-pictures" if PEERS[name].is_square else "pictures"
    data = export_corpus(options.corpus, out / pictures, size_px).resolve()
    length = training_length(options.image_passes, training_image_count(options.corpus))
    passes = f"{length.epochs} epochs, {length.image_passes} image passes"
    say(f"{name}: training, {passes}; {folder / 'train.log'}")
    return {
        "do": "train",
        "config": PEERS[name].config,
        "data": str(data),
        "folder": str(folder),
        "epochs": length.epochs,
        "fraction": length.fraction,
        "size_px": size_px,
        "batch": options.batch,
        "step_images": options.step_images,
        "threads": options.threads,
        "device": options.device,
        "seed": options.seed,
    }


def _latencies(options: ComparisonOptions, detectors: Mapping[str, Detector]) -> list[dict[str, Any]]:
    source = BlindDataset(options.test)
    pairs = [source.pair(index).images for index in source.frame_indices[:_TIMED_PAIRS]]
    return [latency._asdict() for latency in measure_latency(detectors, pairs, options.rounds).values()]


def _scores(
    options: ComparisonOptions, out: Path, detectors: Mapping[str, Detector], say: Say
) -> dict[str, dict[str, Any]]:
    """Overall scores of every detector by our benchmark; detections of the peers are computed once."""
    files = []
    for name, detector in detectors.items():
        file = out / "detections" / f"{name}.json"
        files.append(file)
        # Our detectors may have been trained again under the same name.
        if not file.exists() or name not in PEERS:
            say(f"{name}: detecting the drogue")
            _detect(options.test, detector, file)
    result, page = out / "scores.json", out / "scores.html"
    arguments = [word for file in files for word in ("--detections", str(file))]
    command = [sys.executable, "-P", "-m", "droguekit.cli.main", "benchmark", str(options.test), *arguments]
    command += ["--split", "test", "--json", str(result), "--html", str(page)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise OSError(ended.stderr.strip() or f"benchmark ended with status {ended.returncode}")
    say(f"wrote {page}")
    table = json.loads(result.read_text(encoding="utf-8"))["detectors"]
    return {name: {key: table[name]["overall"][key] for key in ("ap", "ap50", "ap75", "recall")} for name in detectors}


def _detect(corpus: Path, detector: Detector, file: Path) -> None:
    detecting = DetectorRunner(corpus, lambda drogue: detector)
    write_detections(file, detecting.boxes(LEAST_SCORE, lambda: None))


def comparison_lines(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A table with one line per detector; the ratio is that of CPU times, round by round, to the first detector."""
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


def main(
    corpus: CorpusOption,
    out: Annotated[Path, typer.Option("--out", help="Folder; stages that are complete there are skipped.")] = Path(
        "out/detector-peers"
    ),
    test: TestOption = None,
    ours: Annotated[
        list[Path] | None, typer.Option("--ours", metavar="FILE.onnx", help="One of our detectors. Repeatable.")
    ] = None,
    image_passes: PassesOption = 40_000,
    size: SizeOption = "480x640",
    batch: Annotated[
        int, typer.Option("--batch", min=1, help="Images that go through a peer at once in its training.")
    ] = 16,
    step_images: Annotated[
        int,
        typer.Option(
            "--step-images",
            min=1,
            help="Images in a step of the optimizer of ultralytics' networks (its nbs); as many as --batch give it a "
            "step for each batch, as our networks and those of libreyolo have.",
        ),
    ] = ULTRALYTICS_STEP_IMAGES,
    threads: ThreadsOption = 2,
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Number of timing rounds.")] = 50,
    device: DeviceOption = "cpu",
    seed: SeedOption = 0,
    environment: Annotated[
        Path | None,
        typer.Option(
            "--environment", help="Virtual environment of the peers, made if missing; OUT/environment by default."
        ),
    ] = None,
    peer: Annotated[
        list[str] | None,
        typer.Option("--peer", metavar="NAME", help=f"{', '.join(PEERS)}. Repeatable; all by default."),
    ] = None,
) -> None:
    """Train networks of other projects from scratch, time all detectors in turns, and score them by our benchmark.

    With 0 image passes nothing is trained or scored: only parameters, operations and times are measured.
    """
    with wrong_input_ends("detector_comparison"):
        options = ComparisonOptions(
            corpus=corpus,
            test=test or corpus,
            ours=tuple(ours or ()),
            image_passes=image_passes,
            size_px=input_size_px(size),
            batch=batch,
            threads=threads,
            rounds=rounds,
            device="0" if device == "cuda" else device,
            seed=seed,
            environment=environment or out / "environment",
            peers=tuple(peer or PEERS),
            step_images=step_images,
        )
        rows = compare_peers(options, out, print_status)
    typer.echo("\n".join(comparison_lines(rows)))
    typer.echo(f"the numbers are in {out / 'comparison.json'}")


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
