"""`python -m studies.detector_comparison.ablation`: our network with one thing changed at a time, on equal budgets."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.blind import BlindDataset, read_blind_index
from datasets_manifest.types.images import StereoImages
from droguekit.scoring.detection.detection_metrics import Evaluation
from droguekit.scoring.detection.detection_tables import percent_text
from droguekit.scoring.detection.detection_truth import ImageTruth, read_detection_truth
from droguekit.scoring.detection.detector_runner import LEAST_SCORE, DetectorRunner
from geometry.stereo import EYES, Eye
from nav.detector.detector import Detection, Detector, StereoDetection
from nav.detector.onnx_cost import network_cost
from nav.detector.onnx_detector import OnnxDetector
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
from studies.droguekit_command import run_droguekit
from studies.wrong_input import wrong_input_ends


class SingleViewDetector(OnnxDetector):
    """Our network with a pass for each eye, as a network that was trained on single eyes is timed."""

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, if it reaches the score threshold of the file."""
        found = self.candidates(images, self.metadata.score_threshold)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes of each image after non-maximum suppression, the best first."""
        return {eye: self._candidates(images, (eye,), least_score, max_boxes=20)[eye] for eye in EYES}


ONE_VIEW = "one-view"
"""Name of the network that is trained on single eyes and timed with a pass for each eye."""
# Settings by network. The first is what we ship; then the seed paper's ablations, and one of views.
PARTS: dict[str, dict[str, Any]] = {
    "eca-asff": {},
    "se": {"attention": "se"},
    "concat": {"fusion": "concat"},
    "no-mosaic": {"mosaic": False},
    ONE_VIEW: {"views": "one"},
}
# How the network learns: one thing changed at a time, an optimizer with its own rate. Filters were He's before, and
# warm-up took 1,500 passes, here of 5,184.
LEARNING: dict[str, dict[str, Any]] = {
    "eca-asff": {},
    "he-filters": {"filter_sd": 0.0},
    "small-filters": {"filter_sd": 0.01},
    "large-filters": {"filter_sd": 0.1},
    "long-warm-up": {"warmup_fraction": 0.289},
    "asff-equal": {"fusion_start": "equal"},
    "asff-own": {"fusion_start": "own"},
    "muon": {"optimizer": "muon", "learning_rate": 4e-3},
    "sgd": {"optimizer": "sgd", "learning_rate": 2e-2, "weight_decay": 5e-4},
    "rate-half": {"learning_rate": 1e-3},
    "rate-double": {"learning_rate": 4e-3},
    "short-average": {"ema_decay": 0.95},
    "small-batch": {"batch_images": 4},
    "more-cells": {"cells_per_box": 20},
    "cross-entropy": {"focus_power": 0.0},
    "box-weight": {"box_weight": 7.5},
    "own-box-weight": {"fusion_start": "own", "box_weight": 7.5},
    "low-prior": {"prior_score": 1e-3},
    "all-mosaic": {"mosaic_fraction": 1.0},
}
CHANGES = PARTS | LEARNING
_TIMED_PAIRS = 4


@dataclass(frozen=True)
class AblationOptions:
    """Options of the ablations.

    Attributes:
        corpus: dataset to train on.
        test: dataset whose test split is scored.
        variant: of the network, `l` or `s`.
        image_passes: of each network's training.
        size_px: width and height of its input.
        threads, device: of training.
        seeds: of training; every network is trained once with each.
        rounds: of timing.
        networks: names of what is trained, of `CHANGES`.
    """

    corpus: Path
    test: Path
    variant: str
    image_passes: int
    size_px: tuple[int, int]
    threads: int
    seeds: tuple[int, ...]
    device: str
    rounds: int
    networks: tuple[str, ...] = tuple(PARTS)

    def __post_init__(self) -> None:
        if self.image_passes < 1:
            raise ValueError(f"--image-passes: must be at least 1, got {self.image_passes}")
        unknown = [name for name in self.networks if name not in CHANGES]
        if unknown or not self.networks:
            raise ValueError(f"--network: must be of {', '.join(CHANGES)}, got {', '.join(unknown) or 'none'}")


def ablate(options: AblationOptions, out: Path, say: Callable[[str], None]) -> list[str]:
    """Train every network that is not trained yet, time all of them in turns, and make the table.

    Args:
        options: of the ablations.
        out: folder, with a folder for each training.
        say: receives lines about the progress.

    Returns:
        The table's lines; `ablation.json` has the numbers.

    Raises:
        ValueError: a wrong option, or a network or the test dataset that cannot be read.
        OSError: a training failed; the message has the last line of its output.
    """
    read_blind_index(options.test)  # before hours of training
    folders = {name: [out / name / f"seed-{seed}" for seed in options.seeds] for name in options.networks}
    # Seed by seed, so that a run that is stopped has compared all networks.
    for number, seed in enumerate(options.seeds):
        for name in options.networks:
            _train(options, folders[name][number], CHANGES[name] | {"seed": seed}, say)
    files = {name: [folder / "detector.onnx" for folder in each] for name, each in folders.items()}
    rows = measured_networks(options, files, say)
    write_text_atomic(out / "ablation.json", json.dumps({"schema": 1, "networks": rows}, indent=1) + "\n")
    return ablation_lines(rows)


def measured_networks(
    options: AblationOptions, files: Mapping[str, Sequence[Path]], say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Scores on the test split by our benchmark, times measured in turns, and cost of networks.

    Args:
        options: of the ablations.
        files: by name, one for each seed; those of `ONE_VIEW` are run with a pass for each eye. The first is timed.
        say: receives lines about the progress.

    Raises:
        ValueError: a network or the test dataset cannot be read.
    """
    detectors: dict[str, list[Detector]] = {
        name: [
            (SingleViewDetector if name == ONE_VIEW else OnnxDetector)(file, name, options.threads, options.size_px)
            for file in each
        ]
        for name, each in files.items()
    }
    source = BlindDataset(options.test)
    pairs = [source.pair(index).images for index in source.frame_indices[:_TIMED_PAIRS]]
    say("timing in turns")
    latencies = measure_latency({name: first for name, (first, *_) in detectors.items()}, pairs, options.rounds)
    say("detecting the drogue in the test split")
    images = [image for image in read_detection_truth(options.test).images if image.split == "test"]
    return {
        name: {"test": [_test_precision(options.test, detector, images) for detector in each]}
        | latencies[name]._asdict()
        | network_cost(files[name][0], options.size_px)._asdict()
        for name, each in detectors.items()
    }


def _test_precision(dataset: Path, detector: Detector, images: Sequence[ImageTruth]) -> dict[str, float | None] | None:
    """Average precision on some images by the rules of our benchmark; None without images."""
    if not images:
        return None
    detecting = DetectorRunner(dataset, lambda drogue: detector, sorted({image.frame_index for image in images}))
    boxes = list(detecting.boxes(LEAST_SCORE, lambda: None))
    return Evaluation(images, boxes).average_precision(images)._asdict()


def ablation_lines(rows: dict[str, dict[str, Any]]) -> list[str]:
    """A table with one line per network: cost, means of the scores on the test split, times, and AP by seed."""
    lines = [
        f"{'network':<15} {'parameters':>11} {'GFLOPs':>7} {'AP50':>8} {'AP':>8} {'wall [ms]':>10} {'CPU [ms]':>9}  "
        "AP by seed"
    ]
    for name, row in rows.items():
        ap50s, aps = ([None if test is None else test[key] for test in row["test"]] for key in ("ap50", "ap"))
        lines.append(
            f"{name:<15} {row['parameters']:>11,} {row['gflops_per_image']:7.2f} {percent_text(_mean(ap50s)):>8} "
            f"{percent_text(_mean(aps)):>8} {row['wall_ms'][0]:10.1f} {row['cpu_ms'][0]:9.1f}  "
            f"{', '.join(map(percent_text, aps))}"
        )
    return lines


def _mean(values: Sequence[float | None]) -> float | None:
    """None if any is."""
    numbers = [value for value in values if value is not None]
    return sum(numbers) / len(numbers) if values and len(numbers) == len(values) else None


def settings_text(changes: Mapping[str, Any]) -> str:
    """Settings as TOML, whose texts, numbers and truth values are those of JSON."""
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in changes.items())


def _train(options: AblationOptions, folder: Path, changes: Mapping[str, Any], say: Callable[[str], None]) -> None:
    """Start a training, or resume it, unless it is complete."""
    width, height = options.size_px
    arguments = {
        "--out": folder,
        "--cache": folder.parents[1] / "cache",
        "--settings": folder / "ablation.toml",
        "--variant": options.variant,
        "--image-passes": options.image_passes,
        "--size": f"{height}x{width}",
        "--device": options.device,
        "--threads": options.threads,
    }
    say(f"{folder.parent.name}, {folder.name}: training, unless it is complete; {folder / 'train.log'}")
    folder.mkdir(parents=True, exist_ok=True)
    write_text_atomic(folder / "ablation.toml", settings_text(changes))
    words = [word for argument in arguments.items() for word in argument]
    run_droguekit("train", options.corpus, *words, log=folder / "train.log")


_EXAMPLES = """Examples:

  python -m studies.detector_comparison.ablation --corpus data/detector-small --image-passes 5000
  python -m studies.detector_comparison.ablation --corpus data/detector-train --test data/detector-test
  python -m studies.detector_comparison.ablation --corpus data/detector-small --learning --seeds 3"""


def main(
    corpus: CorpusOption,
    out: Annotated[Path, typer.Option("--out", help="Folder; trainings that are found there are resumed.")] = Path(
        "out/ablation"
    ),
    test: TestOption = None,
    variant: Annotated[str, typer.Option("--variant", help="Of the network: l or s.")] = "s",
    image_passes: PassesOption = 5_000,
    size: SizeOption = "320x416",
    threads: ThreadsOption = 2,
    seed: SeedOption = 0,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="Number of trainings of each, from --seed on.")] = 1,
    network: Annotated[
        list[str] | None, typer.Option("--network", metavar="NAME", help=f"Of {', '.join(CHANGES)}. Repeatable.")
    ] = None,
    learning: Annotated[bool, typer.Option("--learning", help="How our network learns, not what it is.")] = False,
    device: DeviceOption = "cpu",
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Number of timing rounds.")] = 30,
) -> None:
    """Train variants of our network that differ in one thing, for the same image passes; measure scores and times."""
    with wrong_input_ends("ablation"):
        options = AblationOptions(
            corpus,
            test or corpus,
            variant,
            image_passes,
            input_size_px(size),
            threads,
            tuple(range(seed, seed + seeds)),
            device,
            rounds,
            tuple(network or (LEARNING if learning else PARTS)),
        )
        lines = ablate(options, out, print_status)
    typer.echo("\n".join(lines))


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
