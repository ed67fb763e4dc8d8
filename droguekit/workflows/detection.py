"""Run a detector on a dataset, without its truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from datasets_manifest.storage.storage import Location
    from droguekit.batch.progress import ProgressReport
    from droguekit.scoring.results.detection_result import DetectedBox, PairTimes


@dataclass(frozen=True)
class DetectionSummary:
    """What `detect_dataset` found, and how long it took."""

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
) -> DetectionSummary:
    """Find the drogue in every image without the truth, and write COCO results; the default detector when None.

    With a tracker, pairs must follow each other in time. The detector then runs only when the drogue is lost, and at
    regular intervals to check the tracker.

    Raises:
        ValueError: no such dataset, detector or tracker, a score outside 0 to 1, or an image that cannot be read.
        OSError: the file cannot be written; it stays as it was.
    """
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
        boxes = write_detections(out, counted())
    finally:
        report.end()
    return DetectionSummary(detecting.name, boxes, len(images), detecting.pairs, detecting.times())
