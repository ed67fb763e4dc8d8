"""The detector: trained from recipes and datasets, which needs torch, and run on a dataset without its truth.

Packages are imported where they are used, so that `--help` stays fast.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from datasets_manifest.storage.storage import as_location
from droguekit.batch.execution import ExecutionOptions
from droguekit.workflows.rendering import open_recipe, render_frames

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import RecipeSource
    from datasets_manifest.storage.storage import Location
    from droguekit.assurance.photograph_check import PhotographCheck
    from droguekit.batch.progress import ProgressReport
    from droguekit.scoring.results.detection_result import DetectedBox, PairTimes
    from nav.training.training_run import TrainingResult

_NEEDED = ("torch", "onnx", "onnxscript", "tensorboard")


@dataclass(frozen=True)
class TrainingOptions:
    """What a detector is trained on, and how.

    Attributes:
        sources: folders or URLs of datasets, and recipes to render.
        settings_file: TOML of training settings, or None.
        changes: to both the file and the defaults; None changes nothing.
        size, final_size: `HEIGHTxWIDTH` of the network's input, or None for what file and defaults say.
        cache: folder for resized images, or None for one in the training's folder.
        start_from: shipped detector or file of initial weights, or None for random ones.
        photographs: folder of pictures without a drogue to train on beside the sources, or None.
        workers: processes that render; as many as cores and memory allow when None.
    """

    sources: tuple[str, ...]
    settings_file: Path | None
    changes: dict[str, Any]
    size: str | None
    final_size: str | None
    cache: Path | None
    start_from: str | None
    photographs: Path | None
    workers: int | None


def _find_source(source: str) -> Location | RecipeSource:
    location = as_location(source)
    if isinstance(location, str) or location.is_dir():
        return location
    return open_recipe(source, None, None)


def _render_source(source: RecipeSource, out: Path, workers: int | None, report: ProgressReport) -> Path:
    """Render the missing pairs of a recipe; returns the dataset's folder."""
    recipe, place = source.recipe, out / "datasets" / source.recipe.name
    report.say(f"rendering {recipe.frames.count} stereo pairs of {recipe.name} into {place}")
    summary = render_frames(source, place, range(recipe.frames.count), ExecutionOptions(workers), report)
    for drop in summary.drops:
        report.say(f"{place}: frame {drop.frame_index} is missing: {drop.reason}")
    return place


def _check_names(sources: Sequence[str], found: Sequence[Location | RecipeSource]) -> None:
    """Check that no two recipes would be rendered into one folder.

    Raises:
        ValueError: two have one name.
    """
    of_name: dict[str, str] = {}
    for source, each in zip(sources, found, strict=True):
        if isinstance(each, Path | str):
            continue
        name = each.recipe.name
        if name in of_name:
            raise ValueError(f"{source}: has the name of {of_name[name]}, {name!r}; give each recipe a name of its own")
        of_name[name] = source


def train_detector(options: TrainingOptions, out: Path, report: ProgressReport) -> TrainingResult:
    """Render what is missing, train, evaluate and export.

    Raises:
        ValueError: a wrong setting, a dataset that cannot be used, or a folder of another training.
        OSError: a file cannot be written.
        KeyboardInterrupt: the user asked to stop, and the state is saved.
    """
    from datasets_manifest.importers.photographs import find_photographs, shown_photograph
    from datasets_manifest.recipe.recipe import RecipeSource
    from droguekit.batch.stop_request import StopRequest
    from nav.training.training_settings import build_settings, parse_size

    changes = {name: value for name, value in options.changes.items() if value is not None}
    sizes = {"size_px": options.size, "final_size_px": options.final_size}
    parsed = {name: parse_size(text) for name, text in sizes.items() if text is not None}
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise ValueError(f"train: {', '.join(missing)} is missing: pip install 'droguekit[train]'")
    # Otherwise torch's threads wait by spinning, which wastes time where other processes use the cores too.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from nav.training.training_state import read_starting_weights

    start = None if options.start_from is None else read_starting_weights(options.start_from)
    network = None if start is None or start.network is None else start.network.to_dict()
    settings = build_settings(options.settings_file, {**changes, **parsed}, network)
    found = [_find_source(source) for source in options.sources]
    from nav.training.training_run import check_training, train

    # Rendering takes hours, so errors that would stop the training are found first.
    if not any(not isinstance(each, RecipeSource) or each.recipe.split.train > 0 for each in found):
        raise ValueError(f"{options.sources[0]}: has no split to train on; give the recipe `[split] train` above 0")
    _check_names(options.sources, found)
    check_training(out, settings, start)
    if options.photographs is not None:
        for path in find_photographs(options.photographs):
            shown_photograph(path)
    datasets = [
        _render_source(each, out, options.workers, report) if isinstance(each, RecipeSource) else each for each in found
    ]
    with StopRequest(report.say) as stop:
        return train(
            datasets, out, settings, report, options.cache, lambda: stop.is_requested, start, options.photographs
        )


def training_lines(result: TrainingResult) -> Iterator[str]:
    """Scores of a training, and the file of its network."""
    for split, reached in (("val", result.validation), ("test", result.test)):
        if reached is not None:
            ap50, ap75, ap, recall50 = (
                f"{100 * value:.2f} %" for value in (reached.ap50, reached.ap75, reached.ap, reached.recall50)
            )
            yield f"{split}: AP50 {ap50}, AP75 {ap75}, AP {ap}, recall at an overlap of 0.5 {recall50}"
    threshold = f"{result.score_threshold:.3f}"
    yield f"{result.file}: the weights after {result.best_step} steps, score threshold {threshold}"


@dataclass(frozen=True)
class DetectionSummary:
    """What `detect_dataset` found, and how long it took.

    Attributes:
        detector: its name.
        boxes: how many.
        images_with_boxes: how many.
        pairs: how many there are.
        times: of the pairs.
        fault: pairs without a result, as one line; None for nothing.
    """

    detector: str
    boxes: int
    images_with_boxes: int
    pairs: int
    times: PairTimes
    fault: str | None = None


def detect_photographs(
    folder: Path, name_or_file: str | None, out: Path, least_score: float | None, report: ProgressReport
) -> PhotographCheck:
    """Find drogues in single pictures, one by one, and write them as a COCO file with images and scores.

    Raises:
        ValueError: no pictures, no such network, or a score outside 0 to 1.
        OSError: the file cannot be written; it stays as it was.
    """
    from datasets_manifest.atomic import write_text_atomic
    from datasets_manifest.storage.writer import canonical_json
    from droguekit.assurance.photograph_check import check_photographs, coco_table
    from nav.detector.detector_registry import DEFAULT_DETECTOR

    found = check_photographs(folder, name_or_file or DEFAULT_DETECTOR, report, least_score=least_score)
    write_text_atomic(out, canonical_json(coco_table(found)) + "\n")
    return found


def detect_dataset(
    dataset: Location,
    name_or_file: str | None,
    out: Path,
    least_score: float,
    report: ProgressReport,
    tracker: str | None = None,
) -> DetectionSummary:
    """Find the drogue in every image without the truth, and write COCO results; the default detector when None.

    With a tracker, pairs must follow each other in time. The detector then runs only when the drogue is lost, and at
    regular intervals to check the tracker.

    Raises:
        ValueError: no such dataset, detector or tracker, a score outside 0 to 1, or no pair without a fault.
        OSError: the file cannot be written; it stays as it was.
    """
    from droguekit.numerical_threads import one_thread
    from droguekit.scoring.detection.detector_runner import DetectorRunner
    from droguekit.scoring.results.detection_result import write_detections
    from nav.detector.detector_registry import DEFAULT_DETECTOR, detector_factory

    if not 0 <= least_score <= 1:
        raise ValueError(f"--least-score: must be from 0 to 1, got {least_score:g}")
    detector_of = detector_factory(DEFAULT_DETECTOR if name_or_file is None else name_or_file)
    if tracker is not None:
        from nav.tracked_detection import tracked_detector_factory

        detector_of = tracked_detector_factory(detector_of, tracker)
    detecting = DetectorRunner(dataset, detector_of)
    images = set()

    def counted() -> Iterator[DetectedBox]:
        for box in detecting.boxes(least_score, report.advance):
            images.add(box.image_id)
            yield box

    report.begin("pairs", detecting.pairs)
    try:
        with one_thread():
            found = list(counted())
    finally:
        report.end()
    times = detecting.times()
    boxes = write_detections(out, found)
    return DetectionSummary(detecting.name, boxes, len(images), detecting.pairs, times, detecting.faults.line())
