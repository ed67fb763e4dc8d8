"""Commands that find the drogue and score what was found: detect, train, navigate, benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import (
    DatasetArgument,
    DetectorOption,
    Place,
    WorkersOption,
    exit_with_fault,
    named_place,
)
from droguekit.cli.outputs import output_option

EXAMPLES = {
    "detect": (
        "droguekit detect data/demo --out detections.json",
        "droguekit detect data/demo --detector color-blob --out color-blob.json",
        "droguekit detect data/flight --detector my-network.onnx --out detections.json",
        "droguekit detect data/flight --detector mobile-s@960x1280 --out small.json   (larger input: smaller drogues)",
        "droguekit detect data/docking-10m --tracker bernoulli --out tracked.json",
        "droguekit detect photographs --mono --out boxes.json   (single pictures of any size)",
    ),
    "train": (
        "droguekit train detector-small --out out/detector --variant s   (renders the recipe first)",
        "droguekit train data/mine data/more --out out/mine --variant s --image-passes 20000 --size 320x416",
        "droguekit train data/mine --out out/mine --size 320x416 --final-size 480x640   (large in the last half)",
        "droguekit train data/mine --out out/mine --start-from mobile-s --image-passes 8000   (from shipped weights)",
        "droguekit train data/mine --out out/mine --settings mine.toml   (learning rate, batch, seed and so on)",
    ),
    "navigate": (
        "droguekit navigate data/demo --out estimates.jsonl",
        "droguekit navigate data/demo --method paper --method joint --out estimates.jsonl",
        "droguekit navigate data/demo --centroids binary --out estimates.jsonl",
        "droguekit navigate data/demo --detector my-network.onnx --out estimates.jsonl",
        "droguekit navigate data/docking-10m --method joint-hub --tracker bernoulli --filter --out estimates.jsonl",
        "droguekit navigate data/docking-10m --method joint-hub --tracker bernoulli --rate 25 --out estimates.jsonl",
        "droguekit navigate --live 0 --calibration stereo.yaml --method joint-hub --filter --out flight.jsonl",
        "droguekit navigate --live rtsp://camera/stereo --calibration stereo.yaml --method joint-hub --out live.jsonl",
        "droguekit navigate --live ros:/left/image_raw,/right/image_raw --calibration stereo.yaml --out flight.jsonl",
    ),
    "benchmark": (
        "droguekit benchmark data/demo --estimates estimates.jsonl --json benchmark.json --html report.html",
        "droguekit benchmark data/demo --estimates somebody-elses.jsonl",
        "droguekit benchmark data/corpus --detections ours.json --detections theirs.json --html detectors.html",
        "droguekit benchmark data/corpus --detector color-blob --json detectors.json",
    ),
}


def detect(
    dataset: DatasetArgument,
    out: Annotated[Path, output_option("--out", "FILE.json", "Write the boxes as COCO results.")],
    detector: DetectorOption = None,
    least_score: Annotated[
        float | None,
        typer.Option(
            "--least-score",
            help="Omit boxes with a lower score; 0.001 by default, with --mono the detector's own threshold.",
        ),
    ] = None,
    tracker: Annotated[
        str | None,
        typer.Option(
            "--tracker",
            metavar="NAME",
            help="Follow the drogue from pair to pair with bernoulli, flow, mil or pose-predict; the detector runs "
            "when the drogue is lost, and on every 25th pair. What it does not find for 75 pairs is given up. "
            "docs/explanation/tracking.md.",
        ),
    ] = None,
    mono: Annotated[
        bool,
        typer.Option(
            "--mono", help="DIR is a folder of single pictures of any sizes; write a COCO file that names them."
        ),
    ] = False,
) -> None:
    """Find the drogue in every image of a dataset, from images, rig and drogue dimensions alone.

    Image ids are those of the dataset's annotations/all.json, even where there is no such file: twice the pair's index,
    plus 1 for the left or 2 for the right image. Exits with 1 where a pair cannot be read or our own code fails in it;
    it then has no boxes.
    """
    from droguekit.workflows.detection import detect_dataset, detect_photographs

    if mono:
        from droguekit.assurance.photograph_check import check_lines

        if tracker is not None or not isinstance(dataset, Path):
            raise ValueError("--mono: takes a folder of this machine, and single pictures cannot be tracked")
        found = detect_photographs(dataset, detector, out, least_score, progress_report())
        typer.echo(next(check_lines(found)))
        typer.echo(f"wrote {out}")
        exit_with_fault(found.fault)
        return
    least_score = 0.001 if least_score is None else least_score
    counts = detect_dataset(dataset, detector, out, least_score, progress_report(), tracker)
    typer.echo(
        f"{counts.detector}: {counts.boxes} boxes in {counts.images_with_boxes} of {2 * counts.pairs} images, "
        f"median {counts.times.wall_ms:.1f} ms a pair ({counts.times.cpu_ms:.1f} ms CPU)"
    )
    typer.echo(f"wrote {out}")
    exit_with_fault(counts.fault)


def train(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="Datasets (folders or URLs) and recipes (shipped or .toml; rendered into OUT/datasets).",
        ),
    ],
    out: Annotated[Path, output_option("--out", "DIR", "The training's folder; made if missing.")],
    variant: Annotated[
        Literal["l", "s"] | None,
        typer.Option("--variant", help="Large or small network; l by default, s takes half the time."),
    ] = None,
    attention: Annotated[
        Literal["eca", "se"] | None, typer.Option("--attention", help="Channel attention; eca by default.")
    ] = None,
    fusion: Annotated[
        Literal["asff", "concat"] | None, typer.Option("--fusion", help="Fusion of the three scales; asff by default.")
    ] = None,
    mosaic: Annotated[
        bool | None, typer.Option("--mosaic/--no-mosaic", help="Mosaic of four images; on by default.")
    ] = None,
    views: Annotated[
        Literal["one", "both"] | None, typer.Option("--views", help="Eyes of a pair in one batch; both by default.")
    ] = None,
    image_passes: Annotated[
        int | None, typer.Option("--image-passes", help="Images in total; 40,000 by default.")
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="HxW", help="Input size, multiples of 32; 480x640 by default.")
    ] = None,
    final_size: Annotated[
        str | None, typer.Option("--final-size", metavar="HxW", help="Input size in the last half; --size by default.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of weights and augmentation; 0 by default.")] = None,
    device: Annotated[
        Literal["cpu", "cuda"] | None, typer.Option("--device", help="Device to train on; cpu by default.")
    ] = None,
    threads: Annotated[int | None, typer.Option("--threads", help="Threads; as many as cores by default.")] = None,
    settings: Annotated[
        Path | None, typer.Option("--settings", metavar="FILE", help="TOML of settings, which options here override.")
    ] = None,
    cache: Annotated[Path | None, output_option("--cache", "DIR", "For resized images; OUT/cache by default.")] = None,
    start_from: Annotated[
        str | None,
        typer.Option(
            "--start-from",
            metavar="NAME|FILE",
            help="Initial weights: mobile-s, mobile-l, an .onnx of droguekit, or best.pt of a training. All but "
            "the last also say variant, attention and fusion.",
        ),
    ] = None,
    photographs: Annotated[
        Path | None,
        typer.Option(
            "--photographs",
            metavar="DIR",
            help="Pictures of any kind and size without a drogue, in which the network learns to find none.",
        ),
    ] = None,
    workers: WorkersOption = None,
) -> None:
    """Train a detector on datasets, evaluate it on their test splits, and export it as ONNX.

    Run again, the same command continues where it stopped. Ctrl-C saves and stops; a second Ctrl-C stops at once. Exits
    with 1 where a pair is damaged, and leaves it out.
    """
    from droguekit.workflows.detection import TrainingOptions, train_detector, training_lines

    changes = {
        "variant": variant,
        "attention": attention,
        "fusion": fusion,
        "mosaic": mosaic,
        "views": views,
        "image_passes": image_passes,
        "seed": seed,
        "device": device,
        "threads": threads,
    }
    options = TrainingOptions(
        tuple(sources), settings, changes, size, final_size, cache, start_from, photographs, workers
    )
    result = train_detector(options, out, progress_report())
    for line in training_lines(result):
        typer.echo(line)
    exit_with_fault(result.fault)


DatasetOrNone = Annotated[
    Place | None,
    typer.Argument(
        metavar="DIR",
        parser=str,
        callback=named_place,
        help="The dataset's folder, or a URL such as s3://BUCKET/NAME; none with --live.",
    ),
]
EstimatesOption = Annotated[Path, output_option("--out", "FILE.jsonl", "Write one estimate a line.")]
MethodOption = Annotated[
    list[str] | None, typer.Option("--method", metavar="NAME", help="Repeatable; all methods by default.")
]
CentroidsOption = Annotated[
    str,
    typer.Option(
        "--centroids",
        metavar="own|binary|edge",
        help="How to measure centres: each method's own way (as the paper, or edge fits), or one for all.",
    ),
]
TrackerOption = Annotated[
    str | None,
    typer.Option(
        "--tracker",
        metavar="NAME",
        help="Follow the drogue; the detector only starts, checks, and searches again after a loss.",
    ),
]
RedetectOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="The detector checks the tracker on every N-th pair; 25 by default."),
]
FilterOption = Annotated[
    bool, typer.Option("--filter", help="Add filtered estimates as METHOD+filter, with docking quantities.")
]
SmoothOption = Annotated[
    bool, typer.Option("--smooth", help="Add estimates smoothed over each sequence as METHOD+smoother.")
]
CaptureRadiusOption = Annotated[
    float | None,
    typer.Option(metavar="M", help="Largest miss that is a capture; by default from the drogue's opening."),
]
RateOption = Annotated[
    float | None,
    typer.Option(metavar="HZ", help="Real time: pairs arrive at this rate; late ones are skipped and counted."),
]
LatencyOption = Annotated[
    Path | None, output_option("--latency", "FILE.json", "Write the latencies of --rate or --live by stage.")
]
LiveOption = Annotated[
    str | None,
    typer.Option(
        "--live",
        metavar="SOURCE",
        help="A running camera: device 0 (views side by side) or 0,1; a video file or an address such as rtsp://...; "
        "or ros:/LEFT,/RIGHT. Until Ctrl-C.",
    ),
]
CalibrationOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="With --live: stereo calibration of the cameras, one file or two as for import."),
]
CalibrationUnitOption = Annotated[
    str | None, typer.Option(metavar="m|cm|mm", help="With --live: unit of the calibration's baseline; m by default.")
]
ImageSizeOption = Annotated[
    str | None, typer.Option(metavar="WIDTHxHEIGHT", help="With --live: of one view, where the calibration lacks it.")
]
DrogueOption = Annotated[
    str | None, typer.Option(metavar="NAME|FILE", help="With --live: preset or .toml file; red-8 by default.")
]
EncodingOption = Annotated[
    str | None,
    typer.Option(metavar="linear|gamma", help="With --live: of pixel values; by default gamma for 8 bit, else linear."),
]
BlackLevelOption = Annotated[
    float | None, typer.Option(metavar="DN", help="With --live: pixel value without light; 0 by default.")
]
BitsOption = Annotated[int | None, typer.Option(help="With --live: bits that the camera uses of 16-bit numbers.")]
TimeoutOption = Annotated[
    float | None,
    typer.Option(metavar="S", help="With --live: end when no pair comes for so long, in a video too; 5 by default."),
]
StampToleranceOption = Annotated[
    float | None,
    typer.Option(metavar="MS", help="With --live: largest difference of the time stamps of left and right; 1."),
]
CameraFormatOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="With --live 0: ask the device for this format, such as mjpeg or gray."),
]


def navigate(
    out: EstimatesOption,
    dataset: DatasetOrNone = None,
    method: MethodOption = None,
    centroids: CentroidsOption = "own",
    detector: DetectorOption = None,
    tracker: TrackerOption = None,
    redetect_every: RedetectOption = None,
    filtered: FilterOption = False,
    smoothed: SmoothOption = False,
    capture_radius: CaptureRadiusOption = None,
    rate: RateOption = None,
    latency: LatencyOption = None,
    live: LiveOption = None,
    calibration: CalibrationOption = None,
    calibration_unit: CalibrationUnitOption = None,
    image_size: ImageSizeOption = None,
    drogue: DrogueOption = None,
    encoding: EncodingOption = None,
    black_level: BlackLevelOption = None,
    bits: BitsOption = None,
    timeout: TimeoutOption = None,
    stamp_tolerance_ms: StampToleranceOption = None,
    camera_format: CameraFormatOption = None,
) -> None:
    """Estimate the drogue's pose in every pair, from images, rig and drogue dimensions alone.

    Pairs come from a dataset, or with --live from a running camera until Ctrl-C. Each estimate is written as soon as it
    exists. Exits with 1 where a pair cannot be read or our own code fails in it, which then gets no fix with that
    reason, and where a camera's run ends by a fault.
    """
    from droguekit.workflows.live_navigation import LiveOptions, navigate_pairs
    from droguekit.workflows.navigation import NavigationOptions

    files = None if not calibration else tuple(calibration)
    images = (files, calibration_unit, image_size, drogue, encoding, black_level, bits)
    camera = LiveOptions(live, *images, timeout, stamp_tolerance_ms, camera_format)
    options = NavigationOptions(
        centroids=centroids,
        detector=detector,
        tracker=tracker,
        redetect_every=redetect_every,
        filtered=filtered,
        smoothed=smoothed,
        capture_radius_m=capture_radius,
        is_live=live is not None,
        rate_hz=rate,
        latency_out=latency,
    )
    done = navigate_pairs(dataset, camera, method or (), out, progress_report(), options)
    for line in done.lines():
        typer.echo(line)
    typer.echo(f"wrote {out}")
    exit_with_fault(done.fault)


def benchmark(
    dataset: DatasetArgument,
    estimates: Annotated[
        Path | None,
        typer.Option("--estimates", metavar="FILE.jsonl", help="Written by `navigate`, or any in that format."),
    ] = None,
    detections: Annotated[
        list[Path] | None,
        typer.Option("--detections", metavar="FILE.json", help="Written by `detect`, or any COCO results. Repeatable."),
    ] = None,
    detector: Annotated[
        list[str] | None,
        typer.Option(
            "--detector",
            metavar="NAME|FILE.onnx",
            help="Run a detector and score it; a network perhaps with @HEIGHTxWIDTH behind it. Repeatable.",
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            "--split", metavar="NAME", help="For detections: train, val, test or all; by default test, if there is one."
        ),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option("--threshold", help="For detections: lowest score that counts in recall and false alarms."),
    ] = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the numbers.")] = None,
    html: Annotated[Path | None, output_option("--html", "FILE", "Write the report as one page.")] = None,
) -> None:
    """Compare pose estimates, or a detector's boxes, with the truth of a dataset.

    An imported dataset has no truth: its estimates are compared with their own measurements, and with boxes if any.
    Exits with 1 where a record is damaged, which is then left out, and where a detector fails in a pair, which then
    counts as without boxes.
    """
    from droguekit.workflows.benchmarking import DetectionOptions, run_benchmarks

    options = DetectionOptions(detections or (), detector or (), split, threshold)
    outcome = run_benchmarks(dataset, estimates, options, (json_, html), progress_report())
    for line in outcome.lines:
        typer.echo(line)
    for path in (json_, html):
        if path is not None:
            typer.echo(f"wrote {path}")
    exit_with_fault(outcome.fault)
