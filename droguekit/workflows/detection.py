"""What the commands do that runs or scores detectors; rooms are imported where they are used, as in `pipelines`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from datasets_manifest.storage.storage import Location
    from droguekit.batch.progress import ProgressReport
    from droguekit.benchmark.detection.detection_scores import DetectorOutput
    from droguekit.benchmark.detection.detector_runner import DetectorRunner
    from droguekit.benchmark.results.detection_result import DetectedBox, DetectionResult, PairTimes
    from nav.detector.onnx_cost import NetworkCost


@dataclass(frozen=True)
class DetectionCounts:
    """What `detect_dataset` did."""

    detector: str
    boxes: int
    images_with_boxes: int
    pairs: int
    times: PairTimes


def detect_dataset(
    dataset: Location,
    name_or_file: str | None,
    out: Path,
    least_score: float,
    report: ProgressReport,
    tracker: str | None = None,
) -> DetectionCounts:
    """Find the drogue in every image without the truth, and write COCO results; the default detector when None.

    With a tracker, pairs are taken to follow each other in time, and the detector looks only where the drogue is lost,
    and at every so manieth pair to check.

    Raises:
        ValueError: no such dataset, detector or tracker, a score that is none, or an image that cannot be read.
        OSError: the file cannot be written; it is then left as it was.
    """
    from droguekit.benchmark.detection.detector_runner import DetectorRunner
    from droguekit.benchmark.results.detection_result import write_detections
    from nav.detector.detector_registry import DEFAULT_DETECTOR, detector_factory

    if not 0 <= least_score <= 1:
        raise ValueError(f"--least-score: must be from 0 to 1, got {least_score:g}")
    detector_of = detector_factory(DEFAULT_DETECTOR if name_or_file is None else name_or_file)
    if tracker is not None:
        from nav.tracking.tracked_detector import tracked_detector_factory

        detector_of = tracked_detector_factory(detector_of, tracker)
    detecting = DetectorRunner(dataset, detector_of)
    images = set()

    def counted() -> Iterator[DetectedBox]:
        for box in detecting.boxes(least_score, report.advance):
            images.add(box.image_id)
            yield box

    report.begin("pairs", detecting.pairs)
    try:
        boxes = write_detections(out, counted())
    finally:
        report.end()
    return DetectionCounts(detecting.name, boxes, len(images), detecting.pairs, detecting.times())


@dataclass(frozen=True)
class DetectionOptions:
    """Which boxes to score, and how.

    Attributes:
        files: of COCO results, each known by its name without ending.
        detectors: names or files of networks, to be run first.
        split: to score on, see `score_detections`.
        threshold: operating threshold, see `score_detections`.
    """

    files: Sequence[Path]
    detectors: Sequence[str]
    split: str | None = None
    threshold: float | None = None


def benchmark_detections(
    dataset: Location, options: DetectionOptions, json_out: Path | None, html_out: Path | None, report: ProgressReport
) -> DetectionResult:
    """Compare boxes with the truth, and write the numbers and the report where a place is given for them.

    Raises:
        ValueError: a dataset, file or detector that cannot be read, or two of one name.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.benchmark.detection.detection_report import write_detection_report
    from droguekit.benchmark.detection.detection_scores import score_detections, split_to_score
    from droguekit.benchmark.detection.detection_truth import read_detection_truth

    if options.threshold is not None and not 0 <= options.threshold <= 1:
        raise ValueError(f"--threshold: must be from 0 to 1, got {options.threshold:g}")
    truth = read_detection_truth(dataset)
    # Whatever is wrong is said before a detector looks at the first image.
    split = split_to_score(truth.images, options.split)
    scored = score_detections(truth, _runs(dataset, options, report), split, options.threshold)
    if json_out is not None:
        write_text_atomic(json_out, scored.result.to_json())
    if html_out is not None:
        write_detection_report(dataset, scored, html_out)
    return scored.result


def _runs(dataset: Location, options: DetectionOptions, report: ProgressReport) -> dict[str, DetectorOutput]:
    """Boxes by the name that they are reported under; everything is opened before the first detector runs."""
    from datasets_manifest.storage.blind import read_blind_index
    from droguekit.benchmark.detection.detection_scores import DetectorOutput
    from droguekit.benchmark.detection.detector_runner import DetectorRunner
    from droguekit.benchmark.results.detection_result import image_id_of, read_detections
    from geometry.stereo import EYES
    from nav.detector.detector_registry import detector_factory

    # Also of images that are not scored, for a detector answers for all.
    image_ids = frozenset(image_id_of(frame, eye) for frame in read_blind_index(dataset).frames for eye in EYES)
    runs = [(file.stem, DetectorOutput(read_detections(file, image_ids))) for file in options.files]
    passes = [(name, DetectorRunner(dataset, detector_factory(name))) for name in options.detectors]
    names = [name for name, _ in runs] + [detecting.name for _, detecting in passes]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--detections, --detector: two are named {name!r}; rename a file")
    runs += [(detecting.name, _detector_run(name, detecting, report)) for name, detecting in passes]
    return dict(runs)


def _detector_run(name_or_file: str, detecting: DetectorRunner, report: ProgressReport) -> DetectorOutput:
    """What a detector finds in all images."""
    from droguekit.benchmark.detection.detection_scores import DetectorOutput
    from droguekit.benchmark.detection.detector_runner import LEAST_SCORE

    report.say(f"{detecting.name}: looking for the drogue, without the truth")
    report.begin("pairs", detecting.pairs)
    try:
        boxes = list(detecting.boxes(LEAST_SCORE, report.advance))
    finally:
        report.end()
    cost = _network_cost(name_or_file, detecting.pass_sizes_px)
    return DetectorOutput(
        boxes,
        detecting.times(),
        detecting.score_threshold,
        parameters=None if cost is None else cost.parameters,
        gflops_per_image=None if cost is None else cost.gflops_per_image,
    )


def _network_cost(name_or_file: str, sizes_px: tuple[tuple[int, int], ...]) -> NetworkCost | None:
    """Of all passes through a network in a file; None where they cannot be counted, or what counts is missing."""
    from importlib.util import find_spec

    from nav.detector.detector_registry import network_file

    file = network_file(name_or_file)
    if file is None or not sizes_px or find_spec("onnx") is None:
        return None
    from nav.detector.onnx_cost import NetworkCost, network_cost

    try:
        costs = [network_cost(file, size_px) for size_px in sizes_px]
    except ValueError:
        # The network runs, and its boxes are not lost for operations that nobody can count.
        return None
    return NetworkCost(costs[0].parameters, sum(cost.gflops_per_image for cost in costs))
