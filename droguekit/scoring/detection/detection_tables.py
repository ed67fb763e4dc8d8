"""Tables of the detection report, as text ready to print, and the published rows of the seed paper."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

from droguekit.scoring.confidence_intervals import Interval
from droguekit.scoring.report.html_page import RowGroup, Table
from droguekit.scoring.report.number_text import ABSENT, plain_number, three_digits
from droguekit.scoring.results.detection_result import DetectionResult, DetectionRow, DetectorResult

SUMMARY_COLUMNS = ("precision", "recall", "AP50", "95 % interval", "AP", "95 % interval", "AP75")
SUMMARY_COLUMNS_MORE = (
    *("parameters [10⁶]", "GFLOPs", "time of an image [ms]"),
    *("false alarms in 600 empty frames", "of 600, frames with any", "95 % interval"),
)
CELL_COLUMNS = ("scenes", "boxes", "AP50", "95 % interval", "AP", "recall", "95 % interval", "precision", "")


class PublishedDetector(NamedTuple):
    """A row of the seed paper's table of detectors.

    Attributes:
        precision, recall, ap50: fractions; the paper does not say at which threshold.
        gflops: of one image, as the paper counts them.
        image_s: time of an image on an Nvidia Xavier AGX. [s]
    """

    name: str
    precision: float
    recall: float
    ap50: float
    gflops: float
    image_s: float


# Table 1 of the seed paper (docs/explanation/paper.md), digit for digit.
PUBLISHED_DETECTORS = (
    PublishedDetector("YOLOv8s", 0.9266, 0.9521, 0.9839, 28.6, 0.0387),
    PublishedDetector("YOLOv5s", 0.9174, 0.9599, 0.9812, 16.5, 0.0311),
    PublishedDetector("Efficientnet-B5", 0.9107, 0.9348, 0.9668, 9.9, 0.0280),
    PublishedDetector("Faster-RCNN", 0.948, 0.9634, 0.9711, 344.4, 0.181),
    PublishedDetector("SSD", 0.9179, 0.9203, 0.9533, 31.0, 0.0470),
    PublishedDetector("YOLOv4", 0.9205, 0.9205, 0.9559, 52.0, 0.0818),
    PublishedDetector("ours-l", 0.93, 0.995, 0.9823, 9.3, 0.0243),
    PublishedDetector("ours-s", 0.9429, 0.9149, 0.9629, 6.0, 0.0202),
)


def summary_table(result: DetectionResult) -> Table:
    """All detectors, and those of the seed paper on its own data."""
    return Table(
        "summary",
        "Detectors, and those of the seed paper on its own data",
        [*SUMMARY_COLUMNS, *SUMMARY_COLUMNS_MORE],
        [
            RowGroup("", summary_rows(result)),
            RowGroup(
                "published, other data (14,298 photographs) and another machine (Nvidia Xavier AGX)",
                published_rows(),
                is_published=True,
            ),
        ],
        first=None,
        second="detector",
    )


def summary_rows(result: DetectionResult) -> list[list[str]]:
    """A row for each detector, in the columns of the paper's table and more."""
    return [[name, *_summary_cells(detector)] for name, detector in result.detectors.items()]


def published_rows() -> list[list[str]]:
    """The paper's rows in the same columns."""
    return [
        [
            row.name,
            *map(percent_text, (row.precision, row.recall, row.ap50)),
            *[ABSENT] * 5,
            f"{row.gflops:g}",
            f"{1e3 * row.image_s:.1f}",
            *[ABSENT] * 3,
        ]
        for row in PUBLISHED_DETECTORS
    ]


def cell_tables(result: DetectionResult) -> list[Table]:
    """By distance, family, eye and split."""
    kinds = [
        ("distances", "By distance", "distance", _distance_cells),
        ("families", "By family", "family", lambda detector: list(detector.families.items())),
        ("eyes", "By eye", "eye", lambda detector: list(detector.eyes.items())),
        ("splits", "By split, each over its own images", "split", lambda detector: list(detector.splits.items())),
    ]
    tables = []
    for anchor, title, first, cells in kinds:
        groups: dict[str, list[list[str]]] = {}
        for name, detector in result.detectors.items():
            for label, row in cells(detector):
                groups.setdefault(label, []).append([name, *_cells(row)])
        if groups:
            rows = [RowGroup(*group) for group in groups.items()]
            notes = frozenset(CELL_COLUMNS[-1:])
            tables.append(Table(anchor, title, list(CELL_COLUMNS), rows, first, "detector", notes))
    return tables


def detector_lines(result: DetectionResult) -> Iterator[str]:
    """The summary as plain lines, for a terminal."""
    yield f"{'detector':<16} {'AP50':>8} {'AP':>8} {'recall':>8} {'precision':>9} {'at score':>9}  false alarms"
    for name, detector in result.detectors.items():
        row, alarms = detector.overall, detector.false_alarms
        false_alarms = "no empty frames" if alarms is None else f"{alarms.boxes} in {alarms.frames} empty frames"
        ap50, ap, recall, precision = map(percent_text, (row.ap50, row.ap, row.recall, row.precision))
        yield (
            f"{name:<16} {ap50:>8} {ap:>8} {recall:>8} {precision:>9} "
            f"{detector.operating_threshold:9.3f}  {false_alarms}"
        )


def percent_text(fraction: float | None) -> str:
    """A fraction in percent with two decimals, as the paper gives it; never all where one is missing."""
    if fraction is None:
        return ABSENT
    shown = math.floor(1e4 * fraction + 0.5) / 100
    shown = min(shown, 99.99) if fraction < 1 else shown
    return f"{shown:.2f} %"


def percent_interval_text(ends: Interval | None) -> str:
    """An interval of fractions."""
    return ABSENT if ends is None else f"{100 * ends[0]:.2f} to {100 * ends[1]:.2f}"


def _summary_cells(detector: DetectorResult) -> list[str]:
    row, alarms, times = detector.overall, detector.false_alarms, detector.times
    return [
        *map(percent_text, (row.precision, row.recall, row.ap50)),
        percent_interval_text(row.ap50_interval),
        percent_text(row.ap),
        percent_interval_text(row.ap_interval),
        percent_text(row.ap75),
        ABSENT if detector.parameters is None else three_digits(1e-6 * detector.parameters),
        ABSENT if detector.gflops_per_image is None else three_digits(detector.gflops_per_image),
        ABSENT if times is None else three_digits(times.wall_ms / 2),
        ABSENT if alarms is None else plain_number(alarms.boxes_per_600_frames),
        ABSENT if alarms is None else plain_number(alarms.frames_with_any_per_600),
        ABSENT if alarms is None else " to ".join(map(plain_number, alarms.interval_per_600_frames)),
    ]


def _distance_cells(detector: DetectorResult) -> list[tuple[str, DetectionRow]]:
    return [
        (f"{row.low_m:g}–{row.high_m:g} m" if row.high_m is not None else f"{row.low_m:g} m and more", row)
        for row in detector.distances
    ]


def _cells(row: DetectionRow) -> list[str]:
    return [
        str(row.scenes),
        str(row.boxes),
        percent_text(row.ap50),
        percent_interval_text(row.ap50_interval),
        percent_text(row.ap),
        percent_text(row.recall),
        percent_interval_text(row.recall_interval),
        percent_text(row.precision),
        row.note or "",
    ]
