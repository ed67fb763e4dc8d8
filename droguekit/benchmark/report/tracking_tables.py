"""The report's part about boxes that follow the drogue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from droguekit.benchmark.report.figures import legend_key
from droguekit.benchmark.report.number_text import ABSENT, interval_text, percent, plain_number, three_digits
from droguekit.benchmark.report.report_tables import Group, Table
from droguekit.benchmark.report.sequence_figures import Styles, overlap_panels
from droguekit.benchmark.results.tracking_result import (
    EyeTracking,
    Losses,
    OverlapRow,
    Reacquisition,
    SourceTracking,
    Tracking,
)

_OVERLAP_COLUMNS = ["images", "AUC", "95 % interval", "mean overlap", "within 20 px", "95 % interval"]
_OVERLAP_COLUMNS += ["normalised precision", "centres, RMS [px]"]
REACQUISITION_COLUMNS = ["re-appearances", "found again", "within 3 frames", "median delay [frames]", "longest"]
# More names than these do not fit in a cell.
_MOST_NAMES = 3


@dataclass(frozen=True)
class ReportPart:
    """Panels, tables and notes that belong together.

    Attributes:
        legend: names and their keys in the panels.
    """

    anchor: str
    title: str
    legend: list[tuple[str, Markup]]
    panels: list[Markup]
    tables: list[Table]
    notes: list[str]


def tracking_part(trackings: Mapping[str, Tracking], first: str, styles: Styles) -> ReportPart | None:
    """The part; None where nothing was tracked.

    Args:
        trackings: by method, detector or tracker.
        first: what these names are.
        styles: those of the names everywhere on the page; names that share an entry have the first one's.
    """
    if not trackings:
        return None
    shared = _without_repeats(trackings)
    named = {_joined(names): trackings[names[0]] for names in shared}
    rows = {name: tracking.both.overlap for name, tracking in named.items() if tracking.both.overlap is not None}
    drawn = {_joined(names): styles[names[0]] for names in shared if _joined(names) in rows}
    return ReportPart(
        anchor="tracking",
        title="Boxes that follow the drogue",
        legend=legend_of(drawn),
        panels=[Markup(panel) for panel in (overlap_panels(rows, drawn) if rows else [])],
        tables=[_overlap_table(named, first), *_source_tables(named, first), _loss_table(named, first)],
        notes=_NOTES,
    )


def legend_of(styles: Styles) -> list[tuple[str, Markup]]:
    """Names and keys for a legend."""
    return [(name, Markup(legend_key(style))) for name, style in styles.items()]


def reacquisition_cells(row: Reacquisition) -> list[str]:
    """In the columns of `REACQUISITION_COLUMNS`."""
    delays = (ABSENT, ABSENT) if row.median_frames is None else (plain_number(row.median_frames), str(row.max_frames))
    return [str(row.n), str(row.found), str(row.within_3), *delays]


def _without_repeats(trackings: Mapping[str, Tracking]) -> list[list[str]]:
    """Methods that worked in the same boxes share one entry, for their names would stand on equal numbers."""
    names: dict[str, list[str]] = {}
    for name, tracking in trackings.items():
        same = (other for other in names if _boxes_of(trackings[other]) == _boxes_of(tracking))
        names.setdefault(next(same, name), []).append(name)
    return list(names.values())


def _boxes_of(tracking: Tracking) -> tuple[object, ...]:
    """What does not depend on the time that a method took."""
    return (tracking.both, tracking.eyes, {name: source.overlap for name, source in tracking.sources.items()})


def _joined(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= _MOST_NAMES else f"{names[0]} and {len(names) - 1} others"


def _overlap_table(trackings: Mapping[str, Tracking], first: str) -> Table:
    groups = [
        Group(name, [[label, *_overlap_cells(row.overlap)] for label, row in _by_eye(tracking)])
        for name, tracking in trackings.items()
    ]
    return Table("overlap", "Boxes against the true ones (OTB)", _OVERLAP_COLUMNS, groups, first, "eye")


def _source_tables(trackings: Mapping[str, Tracking], first: str) -> list[Table]:
    """By who gave the box; none where nobody says so."""
    groups = [
        Group(name, [[source, *_source_cells(row)] for source, row in tracking.sources.items()])
        for name, tracking in trackings.items()
        if tracking.sources
    ]
    columns = ["pairs", *_OVERLAP_COLUMNS, "box, median [ms]", "whole pair", "p95"]
    return [Table("sources", "The same by source of the box", columns, groups, first, "source")] if groups else []


def _loss_table(trackings: Mapping[str, Tracking], first: str) -> Table:
    groups = [
        Group(name, [[label, *_loss_cells(row)] for label, row in _by_eye(tracking)])
        for name, tracking in trackings.items()
    ]
    columns = ["minutes in sight", "losses", "a minute", "95 % interval", "images lost", *REACQUISITION_COLUMNS]
    columns += ["images without the drogue", "with a box"]
    return Table("losses", "Losses, and finding the drogue again", columns, groups, first, "eye")


def _by_eye(tracking: Tracking) -> list[tuple[str, EyeTracking]]:
    return [("both", tracking.both), *tracking.eyes.items()]


def _overlap_cells(row: OverlapRow | None) -> list[str]:
    if row is None:
        return ["0", *[ABSENT] * (len(_OVERLAP_COLUMNS) - 1)]
    return [
        str(row.n),
        three_digits(row.auc),
        interval_text(row.auc_interval),
        three_digits(row.mean_overlap),
        percent(row.precision),
        _shares(row.precision_interval),
        three_digits(row.normalized_precision),
        three_digits(row.center_rms_px),
    ]


def _source_cells(row: SourceTracking) -> list[str]:
    return [
        str(row.pairs),
        *_overlap_cells(row.overlap),
        *map(three_digits, (row.box_ms, row.frame_ms, row.frame_p95_ms)),
    ]


def _loss_cells(row: EyeTracking) -> list[str]:
    return [
        *_rate_cells(row.losses),
        *reacquisition_cells(row.reacquisition),
        str(row.hidden),
        str(row.hidden_with_box),
    ]


def _rate_cells(losses: Losses | None) -> list[str]:
    if losses is None:
        return [ABSENT] * 5
    return [
        three_digits(losses.minutes),
        str(losses.count),
        three_digits(losses.per_minute),
        interval_text(losses.per_minute_interval),
        percent(round(losses.lost_fraction, 4)),
    ]


def _shares(ends: tuple[float, float] | None) -> str:
    return ABSENT if ends is None else f"{percent(round(ends[0], 3))} to {percent(round(ends[1], 3))}"


_NOTES = [
    "The true box goes around the drogue's visible pixels; images that show less than half of the drogue do not count. "
    "An image without a box counts as no overlap, and its centre as infinitely far; by source, only images with a box "
    "of that source count.",
    "AUC is the area under the success plot: the mean share of overlaps above 0, 0.05, ... 1. As none is above 1, a "
    "perfect tracker reaches 0.952. Normalised precision is the mean share of centres within 0 to 0.5 of the true "
    "box's width and height.",
    "A loss begins when the box is missing, or overlaps the true one by less than 0.1, after an image in which the "
    "drogue was followed. Both eyes mostly lose it together, so the row of both is that of the eye with more losses. "
    "The interval of the rate is that of a Poisson law; the others come from resampled sequences, and need two.",
    "After the drogue was hidden, or lost beside the sun, a box finds it again when it overlaps the true one by half. "
    "The delay counts from the first image that shows half of it, which is 0.",
]
