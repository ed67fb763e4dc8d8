"""Score pose estimates and detections against a dataset's truth, or against its images alone where it has none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from datasets_manifest.storage.layout import BLIND_FILE
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.storage import Location, open_storage

if TYPE_CHECKING:
    from droguekit.batch.progress import ProgressReport
    from droguekit.scoring.blind_check import BlindCheck
    from droguekit.scoring.detection.detection_scores import DetectorOutput
    from droguekit.scoring.detection.detector_runner import DetectorRunner
    from droguekit.scoring.results.benchmark_result import BenchmarkResult
    from droguekit.scoring.results.detection_result import DetectionResult
    from nav.detector.onnx_cost import NetworkCost


@dataclass(frozen=True)
class DetectionOptions:
    """Which boxes to score, and how.

    Attributes:
        files: of COCO results; the name without suffix is the detector's.
        detectors: names or network files of detectors to run first.
        split: to score on, see `score_detections`.
        threshold: operating threshold, see `score_detections`.
    """

    files: Sequence[Path]
    detectors: Sequence[str]
    split: str | None = None
    threshold: float | None = None


@dataclass(frozen=True)
class BenchmarkOutcome:
    """What a benchmark tells.

    Attributes:
        lines: of the result.
        fault: pairs that are damaged or in which a detector failed, as one line; None for nothing.
    """

    lines: Iterator[str]
    fault: str | None = None


def run_benchmarks(
    dataset: Location,
    estimates: Path | None,
    options: DetectionOptions,
    outputs: tuple[Path | None, Path | None],
    report: ProgressReport,
) -> BenchmarkOutcome:
    """Compare estimates, or a detector's boxes, with the truth.

    Args:
        dataset: with its truth, or an imported one without.
        estimates: file of poses; None for detections.
        options: which detections.
        outputs: files for the numbers as JSON and for the report as HTML, or None.
        report: is told of the progress of detectors.

    Raises:
        ValueError: estimates and detections together, or inputs that cannot be read.
        OSError: a result cannot be written.
    """
    json_out, html_out = outputs
    wants_detections = bool(options.files or options.detectors)
    if (estimates is not None) == wants_detections:
        raise ValueError("--estimates: give either estimates, or detections (--detections, --detector)")
    if estimates is None:
        from droguekit.scoring.detection.detection_tables import detector_lines

        result, fault = benchmark_detections(dataset, options, json_out, html_out, report)
        return BenchmarkOutcome(detector_lines(result), fault)
    if options.split is not None or options.threshold is not None:
        raise ValueError("--split, --threshold: are for detections, not for estimates")
    faults = PairFaults()
    if open_storage(dataset).exists(BLIND_FILE):
        check = check_blind_dataset(dataset, estimates, json_out, html_out, faults)
        return BenchmarkOutcome(_blind_lines(check), faults.line())
    scored = benchmark_dataset(dataset, estimates, json_out, html_out, faults)
    return BenchmarkOutcome(_error_lines(scored), faults.line())


def _error_lines(result: BenchmarkResult) -> Iterator[str]:
    yield f"{'method':<16} {'fixes':>7} {'mean':>9} {'rmse':>9} {'p95':>9}   position error [mm]"
    for name, scores in result.methods.items():
        row = scores.overall
        errors = (row.position_mean_m, row.position_rmse_m, row.position_p95_m)
        shown = " ".join(f"{'-':>9}" if error is None else f"{1e3 * error:9.1f}" for error in errors)
        yield f"{name:<16} {100 * row.fix_fraction:6.1f}% {shown}"


def _blind_lines(check: BlindCheck) -> Iterator[str]:
    from droguekit.scoring.blind_check import COLUMNS, row_cells

    yield f"{check.dataset.name} has no true poses: estimates are compared with their own measurements and with boxes"
    yield " ".join([f"{'method':<16}", *(f"{column:>16}" for column in COLUMNS)])
    for name in check.methods:
        yield " ".join([f"{name:<16}", *(f"{cell:>16}" for cell in row_cells(check, name))])


def benchmark_dataset(
    dataset: Location,
    estimates: Path,
    json_out: Path | None,
    html_out: Path | None,
    faults: PairFaults | None = None,
) -> BenchmarkResult:
    """Compare estimates with the truth, and write numbers and report where files are given.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.numerical_threads import one_thread
    from droguekit.scoring.pose_benchmark import run_benchmark
    from droguekit.scoring.report.pose_report import write_report

    with one_thread():
        result = run_benchmark(dataset, estimates, faults)
        if json_out is not None:
            write_text_atomic(json_out, result.to_json())
        if html_out is not None:
            write_report(dataset, estimates, result, html_out, faults)
    return result


def check_blind_dataset(
    dataset: Location,
    estimates: Path,
    json_out: Path | None,
    html_out: Path | None,
    faults: PairFaults | None = None,
) -> BlindCheck:
    """Without truth, compare estimates with their own measurements, and with boxes if there are any.

    Raises:
        ValueError: a dataset or estimates that cannot be read.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.numerical_threads import one_thread
    from droguekit.scoring.blind_check import check_blind, write_blind_report

    with one_thread():
        check = check_blind(dataset, estimates, faults)
        if json_out is not None:
            write_text_atomic(json_out, check.to_json())
        if html_out is not None:
            write_blind_report(dataset, estimates, check, html_out, faults)
    return check


def benchmark_detections(
    dataset: Location, options: DetectionOptions, json_out: Path | None, html_out: Path | None, report: ProgressReport
) -> tuple[DetectionResult, str | None]:
    """Compare boxes with the truth, and write numbers and report where files are given.

    Returns:
        The result, and pairs in which a detector failed as one line; None for nothing. They count as without boxes.

    Raises:
        ValueError: a dataset, file or detector that cannot be read, or two of one name.
        OSError: a result cannot be written.
    """
    from datasets_manifest.atomic import write_text_atomic
    from droguekit.scoring.detection.detection_report import write_detection_report
    from droguekit.scoring.detection.detection_scores import score_detections, split_to_score
    from droguekit.scoring.detection.detection_truth import read_detection_truth

    if options.threshold is not None and not 0 <= options.threshold <= 1:
        raise ValueError(f"--threshold: must be from 0 to 1, got {options.threshold:g}")
    faults = PairFaults()
    truth = read_detection_truth(dataset, faults)
    # Errors are found before a detector runs.
    split = split_to_score(truth.images, options.split)
    runs, fault = _runs(dataset, options, report)
    scored = score_detections(truth, runs, split, options.threshold)
    if json_out is not None:
        write_text_atomic(json_out, scored.result.to_json())
    if html_out is not None:
        write_detection_report(dataset, scored, html_out, faults)
    return scored.result, faults.line() or fault


def _runs(
    dataset: Location, options: DetectionOptions, report: ProgressReport
) -> tuple[dict[str, DetectorOutput], str | None]:
    """Boxes by their name in the report, and a detector's faults; all files are opened before a detector runs."""
    from datasets_manifest.storage.blind import read_blind_index
    from droguekit.scoring.detection.detection_scores import DetectorOutput
    from droguekit.scoring.detection.detector_runner import DetectorRunner
    from droguekit.scoring.results.detection_result import image_id_of, read_detections
    from geometry.stereo import EYES
    from nav.detector.detector_registry import detector_factory

    # Files may also have boxes of images that are not scored.
    image_ids = frozenset(image_id_of(frame, eye) for frame in read_blind_index(dataset).frames for eye in EYES)
    runs = [(file.stem, DetectorOutput(read_detections(file, image_ids))) for file in options.files]
    passes = [(name, DetectorRunner(dataset, detector_factory(name))) for name in options.detectors]
    names = [name for name, _ in runs] + [detecting.name for _, detecting in passes]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"--detections, --detector: two are named {name!r}; rename a file")
    runs += [(detecting.name, _detector_run(name, detecting, report)) for name, detecting in passes]
    faults = (f"{detecting.name}: {line}" for _, detecting in passes if (line := detecting.faults.line()) is not None)
    return dict(runs), next(faults, None)


def _detector_run(name_or_file: str, detecting: DetectorRunner, report: ProgressReport) -> DetectorOutput:
    """Run a detector on all images."""
    from droguekit.numerical_threads import one_thread
    from droguekit.scoring.detection.detection_scores import DetectorOutput
    from droguekit.scoring.detection.detector_runner import LEAST_SCORE

    report.say(f"{detecting.name}: detecting the drogue, without the truth")
    report.begin("pairs", detecting.pairs)
    try:
        with one_thread():
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
    """Cost of all passes through a network file; None where it cannot be computed or onnx is missing."""
    from importlib.util import find_spec

    from nav.detector.detector_registry import network_file, split_input_size

    file = network_file(split_input_size(name_or_file)[0])
    if file is None or not sizes_px or find_spec("onnx") is None:
        return None
    from nav.detector.onnx_cost import NetworkCost, network_cost

    try:
        costs = [network_cost(file, size_px) for size_px in sizes_px]
    except ValueError:
        # The network runs even if its operations cannot be counted.
        return None
    return NetworkCost(costs[0].parameters, sum(cost.gflops_per_image for cost in costs))
