"""`python -m studies.detector_comparison.ablation`: our network with one thing changed at a time, on equal budgets."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
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
from nav.detector.input_image import input_image
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


class SingleViewDetector(OnnxDetector):
    """Our network with a pass for each eye, as a network that was trained on single eyes is timed."""

    def detect(self, images: StereoImages) -> StereoDetection:
        """The best box in each image, if it reaches the score threshold of the file."""
        found = self.candidates(images, self.metadata.score_threshold)
        return StereoDetection(*(next(iter(found[eye]), None) for eye in EYES))

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        """The boxes of each image after non-maximum suppression, the best first."""
        candidates: dict[Eye, tuple[Detection, ...]] = {}
        for eye in EYES:
            image, placement = input_image(images, eye, self.input_size_px)
            ((boxes, scores),) = self._detect([image], least_score, max_boxes=20)
            candidates[eye] = tuple(
                Detection((x, y, width, height), score)
                for (x, y, width, height), score in zip(
                    placement.to_image(boxes).tolist(), scores.tolist(), strict=True
                )
            )
        return candidates


ONE_VIEW = "one-view"
"""Name of the network that is trained on single eyes and timed with a pass for each eye."""
# Options of `droguekit train` by network. The first is what we ship; then the seed paper's ablations, and one of views.
CHANGES: dict[str, tuple[str, ...]] = {
    "eca-asff": (),
    "se": ("--attention", "se"),
    "concat": ("--fusion", "concat"),
    "no-mosaic": ("--no-mosaic",),
    ONE_VIEW: ("--views", "one"),
}
_INTERRUPTED = 130
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
        threads, seed, device: of training.
        rounds: of timing.
    """

    corpus: Path
    test: Path
    variant: str
    image_passes: int
    size_px: tuple[int, int]
    threads: int
    seed: int
    device: str
    rounds: int

    def __post_init__(self) -> None:
        if self.image_passes < 1:
            raise ValueError(f"--image-passes: must be at least 1, got {self.image_passes}")


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
    for name, changes in CHANGES.items():
        _train(options, out / name, changes, say)
    rows = measured_networks(options, {name: out / name / "detector.onnx" for name in CHANGES}, say)
    write_text_atomic(out / "ablation.json", json.dumps({"schema": 1, "networks": rows}, indent=1) + "\n")
    return ablation_lines(rows)


def measured_networks(
    options: AblationOptions, files: dict[str, Path], say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Scores on the test split by our benchmark, times measured in turns, and cost of networks.

    Args:
        options: of the ablations.
        files: by name; the one of `ONE_VIEW` is run with a pass for each eye.
        say: receives lines about the progress.

    Raises:
        ValueError: a network or the test dataset cannot be read.
    """
    detectors: dict[str, Detector] = {
        name: (SingleViewDetector if name == ONE_VIEW else OnnxDetector)(file, name, options.threads, options.size_px)
        for name, file in files.items()
    }
    source = BlindDataset(options.test)
    pairs = [source.pair(index).images for index in source.frame_indices[:_TIMED_PAIRS]]
    say("timing in turns")
    latencies = measure_latency(detectors, pairs, options.rounds)
    say("detecting the drogue in the test split")
    images = [image for image in read_detection_truth(options.test).images if image.split == "test"]
    return {
        name: {"test": _test_precision(options.test, detector, images)}
        | latencies[name]._asdict()
        | network_cost(files[name], options.size_px)._asdict()
        for name, detector in detectors.items()
    }


def _test_precision(dataset: Path, detector: Detector, images: Sequence[ImageTruth]) -> dict[str, float | None] | None:
    """Average precision on some images by the rules of our benchmark; None without images."""
    if not images:
        return None
    detecting = DetectorRunner(dataset, lambda drogue: detector, sorted({image.frame_index for image in images}))
    boxes = list(detecting.boxes(LEAST_SCORE, lambda: None))
    return Evaluation(images, boxes).average_precision(images)._asdict()


def ablation_lines(rows: dict[str, dict[str, Any]]) -> list[str]:
    """A table with one line per network: cost, scores on the test split, and times."""
    lines = [
        f"{'network':<12} {'parameters':>11} {'GFLOPs':>7} {'AP50':>8} {'AP':>8} {'wall [ms]':>10} {'CPU [ms]':>9}"
    ]
    for name, row in rows.items():
        test = row["test"]
        ap50, ap = (percent_text(None if test is None else test[key]) for key in ("ap50", "ap"))
        lines.append(
            f"{name:<12} {row['parameters']:>11,} {row['gflops_per_image']:7.2f} {ap50:>8} {ap:>8} "
            f"{row['wall_ms'][0]:10.1f} {row['cpu_ms'][0]:9.1f}"
        )
    return lines


def _train(options: AblationOptions, folder: Path, changes: tuple[str, ...], say: Callable[[str], None]) -> None:
    """Start a training, or resume it, unless it is complete."""
    width, height = options.size_px
    arguments = {
        "--out": folder,
        "--cache": folder.parent / "cache",
        "--variant": options.variant,
        "--image-passes": options.image_passes,
        "--size": f"{height}x{width}",
        "--seed": options.seed,
        "--device": options.device,
        "--threads": options.threads,
    }
    say(f"{folder.name}: training, unless it is complete; {folder / 'train.log'}")
    folder.mkdir(parents=True, exist_ok=True)
    words = [str(word) for argument in arguments.items() for word in argument]
    with (folder / "train.log").open("a", encoding="utf-8") as log:
        ended = subprocess.run(
            # -P: a file in the working folder must not replace a module of ours.
            [sys.executable, "-P", "-m", "droguekit.cli.main", "train", str(options.corpus), *words, *changes],
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            check=False,
        )
    if ended.returncode == _INTERRUPTED:
        raise OSError(f"{folder}: the training was interrupted; the same command resumes it")
    if ended.returncode != 0:
        said = (folder / "train.log").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise OSError(f"{folder / 'train.log'}: {said[-1] if said else 'the training failed silently'}")


_EXAMPLES = """Examples:

  python -m studies.detector_comparison.ablation --corpus data/detector-small --image-passes 5000
  python -m studies.detector_comparison.ablation --corpus data/detector-train --test data/detector-test"""


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
    device: DeviceOption = "cpu",
    rounds: Annotated[int, typer.Option("--rounds", min=1, help="Number of timing rounds.")] = 30,
) -> None:
    """Train variants of our network that differ in one thing, for the same image passes; measure scores and times."""
    try:
        options = AblationOptions(
            corpus, test or corpus, variant, image_passes, input_size_px(size), threads, seed, device, rounds
        )
        lines = ablate(options, out, print_status)
    except (ValueError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error
    typer.echo("\n".join(lines))


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
