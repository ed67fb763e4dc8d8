"""The detector benchmark as one HTML page that needs nothing from outside: no network, no script, no other file."""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.storage import Location
from droguekit.benchmark.detection.detection_benchmark import ScoredDetections
from droguekit.benchmark.detection.detection_figures import (
    MEASURES,
    curve_panel,
    distance_panel,
    score_panel,
    size_panel,
)
from droguekit.benchmark.detection.detection_pictures import detection_pictures
from droguekit.benchmark.detection.detection_scores import LEAST_BOXES, LEAST_SCENES
from droguekit.benchmark.detection.detection_speed import is_timed, speed_panel
from droguekit.benchmark.detection.detection_tables import (
    CELL_COLUMNS,
    SUMMARY_COLUMNS,
    SUMMARY_COLUMNS_MORE,
    cell_tables,
    published_rows,
    share,
    summary_rows,
)
from droguekit.benchmark.report.figures import legend_key, method_styles
from droguekit.benchmark.report.number_text import plain_number
from droguekit.benchmark.report.report import page_template
from droguekit.benchmark.report.tracking_tables import tracking_part
from droguekit.benchmark.results.detection_result import DetectionResult


def write_detection_report(dataset: Location, scored: ScoredDetections, out_html: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        dataset: the dataset's folder or URL, for pictures.
        scored: what `score_detections` made of it.
        out_html: where to write.

    Raises:
        ValueError: an image cannot be read.
        OSError: the page cannot be written.
    """
    result = scored.result
    matches = {name: evaluation.matches(scored.images) for name, evaluation in scored.evaluations.items()}
    thresholds = {name: detector.operating_threshold for name, detector in result.detectors.items()}
    best = best_detector(result)
    styles = method_styles(list(matches))
    histograms = [
        Markup(panel(name, number, matches[name], thresholds[name]))
        for number, name in enumerate(matches)
        for panel in (score_panel, size_panel)
    ]
    page = page_template("detection_report.html.j2").render(
        result=result,
        sentences=detection_sentences(result, best),
        facts=_facts(result),
        summary_columns=[*SUMMARY_COLUMNS, *SUMMARY_COLUMNS_MORE],
        summary=summary_rows(result),
        published=published_rows(),
        cell_columns=CELL_COLUMNS,
        tables=cell_tables(result),
        legend=[(name, Markup(legend_key(style))) for name, style in styles.items()],
        distance_panels=[Markup(distance_panel(result, measure)) for measure in MEASURES if _has_distances(result)],
        curve=Markup(curve_panel(matches)),
        speed=Markup(speed_panel(result)) if is_timed(result) else None,
        histograms=histograms,
        tracking=tracking_part(
            {name: d.sequences for name, d in result.detectors.items() if d.sequences is not None}, "detector", styles
        ),
        pictured=best,
        pictures=detection_pictures(dataset, matches[best], thresholds[best]),
        least=(LEAST_BOXES, LEAST_SCENES),
    )
    write_text_atomic(out_html, page)


def best_detector(result: DetectionResult) -> str:
    """The name of the one with the highest AP, the first among equals."""
    return max(result.detectors, key=lambda name: result.detectors[name].overall.ap or 0.0)


def detection_sentences(result: DetectionResult, name: str) -> list[str]:
    """What came out, in words."""
    data, detector = result.dataset, result.detectors[name]
    row, alarms = detector.overall, detector.false_alarms
    images = (
        f"{data.images} images of {data.name}"
        if data.split == "all"
        else f"the {data.images} images of split {data.split}"
    )
    chosen = {
        "given": "which was given",
        "detector": "which is its own threshold",
        "val": "which is the best one on split val",
        "scored images": "which is the best one on these same images",
    }
    sentences = [
        f"On {images}, with {data.boxes} drogues of {row.scenes} scenes to be found, {name} reaches an AP50 of "
        f"{share(row.ap50)} and an AP of {share(row.ap)}.",
        f"With a score of {plain_number(detector.operating_threshold)} or more, {chosen[detector.threshold_from]}, "
        f"it finds {share(row.recall)} of the drogues, and {share(row.precision)} of its boxes are right.",
    ]
    if alarms is not None:
        sentences.append(f"In {alarms.frames} pairs without a drogue it sees {alarms.boxes}.")
    return sentences


def _has_distances(result: DetectionResult) -> bool:
    return any(detector.distances for detector in result.detectors.values())


def _facts(result: DetectionResult) -> list[tuple[str, str]]:
    data = result.dataset
    thresholds = [
        f"{name} {plain_number(detector.operating_threshold)} ({detector.threshold_from})"
        for name, detector in result.detectors.items()
    ]
    return [
        ("Dataset", data.name),
        ("Content hash (SHA-256)", data.sha256 or "none, imported"),
        ("Split", data.split),
        ("Images", str(data.images)),
        ("Drogues to be found", str(data.boxes)),
        (
            "Drogues that count neither way",
            f"{data.ignored}, of which less than {share(result.least_seen_fraction)} is seen",
        ),
        ("Pairs without a drogue", str(data.empty_frames)),
        ("Operating thresholds", "; ".join(thresholds)),
    ]
