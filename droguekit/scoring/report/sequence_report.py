"""The report's section about sequences."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from markupsafe import Markup

from droguekit.scoring.report.figures import (
    DistanceLine,
    MethodStyle,
    Point,
    Styles,
    distance_lines_panel,
    legend_key,
    overlap_panels,
)
from droguekit.scoring.report.html_page import ReportPart
from droguekit.scoring.report.number_text import millimetres, percent, plain_number, three_digits
from droguekit.scoring.report.sequence_tables import (
    docking_tables,
    filter_tables,
    hiding_table,
    latency_tables,
    tracking_tables,
)
from droguekit.scoring.results.sequence_result import (
    DockingBin,
    DockingErrors,
    FilterErrors,
    Latency,
    LatencyBin,
    MethodSequences,
    MotionBin,
    SequencesResult,
    Tracking,
)

_Bin = TypeVar("_Bin", MotionBin, DockingBin, LatencyBin)


# More names than these do not fit in a cell.
_MOST_NAMES = 3

_TRACKING_NOTES = [
    "The true box goes around the drogue's visible pixels; images that show less than half of the drogue do not count. "
    "An image without a box counts as no overlap, and its centre as infinitely far; by source, only images with a box "
    "of that source count.",
    "AUC is the area under the success plot: the mean share of overlaps above 0, 0.05, ... 1. As none is above 1, a "
    "perfect tracker reaches 0.952. Normalised precision is the mean share of centres within 0 to 0.5 of the true "
    "box's width and height.",
    "A loss begins when the box is missing, or overlaps the true one by less than 0.1, after an image in which the "
    "drogue was followed. Both eyes mostly lose it together, so the row of both is that of the eye with more losses. "
    "The interval of the rate is that of a Poisson law; the others are Student's over sequences, and need two.",
    "After the drogue was hidden, or lost beside the sun, a box finds it again when it overlaps the true one by half. "
    "The delay counts from the first image that shows half of it, which is 0.",
]


@dataclass(frozen=True)
class SequenceSection:
    """The section about sequences.

    Attributes:
        sentences: the result in words.
        parts: in the order of the page.
    """

    sentences: list[str]
    parts: list[ReportPart]


def sequence_section(result: SequencesResult, styles: Mapping[str, MethodStyle]) -> SequenceSection:
    """The section of a result; `styles` are those of the methods everywhere on the page."""
    methods = result.methods
    parts = [
        tracking_part({name: m.tracking for name, m in methods.items() if m.tracking is not None}, "method", styles),
        _hiding_part(methods),
        _filter_part({name: m.filtering for name, m in methods.items() if m.filtering is not None}, styles, result),
        _docking_part({name: m.docking for name, m in methods.items() if m.docking is not None}, styles),
        _latency_part({name: m.latency for name, m in methods.items() if m.latency is not None}, styles),
    ]
    return SequenceSection(sequence_sentences(result), [part for part in parts if part is not None])


def sequence_sentences(result: SequencesResult) -> list[str]:
    """The result over sequences, in sentences."""
    sequences = "One sequence" if result.count == 1 else f"{result.count} sequences"
    sentences = [f"{sequences} of {plain_number(60 * result.minutes)} s in all, {result.pairs} pairs."]
    for name, method in result.methods.items():
        words = [*_filter_words(method), *_docking_words(method)]
        if method.filtering is None or method.filtering.raw is None:
            # A filter shares the boxes and the latency of the method that it filters.
            words = [*_tracking_words(method), *words, *_latency_words(method)]
        if words:
            sentences.append(f"{name}: {'; '.join(words)}.")
    if any(method.hiding.hidden for method in result.methods.values()):
        wrong = {name: m.hiding.poses_while_hidden for name, m in result.methods.items() if m.hiding.poses_while_hidden}
        names = ", ".join(f"{name} {count}" for name, count in wrong.items())
        sentences.append(f"Poses while the drogue was hidden: {names or 'none'}.")
    return sentences


def tracking_part(trackings: Mapping[str, Tracking], first: str, styles: Styles) -> ReportPart | None:
    """The part about tracked boxes; None where nothing was tracked.

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
        tables=tracking_tables(named, first),
        notes=_TRACKING_NOTES,
    )


def legend_of(styles: Styles) -> list[tuple[str, Markup]]:
    """Names and keys for a legend."""
    return [(name, Markup(legend_key(style))) for name, style in styles.items()]


def _without_repeats(trackings: Mapping[str, Tracking]) -> list[list[str]]:
    """Methods with the same boxes share one entry, as their numbers are equal."""
    names: dict[str, list[str]] = {}
    for name, tracking in trackings.items():
        same = (other for other in names if _boxes_of(trackings[other]) == _boxes_of(tracking))
        names.setdefault(next(same, name), []).append(name)
    return list(names.values())


def _boxes_of(tracking: Tracking) -> tuple[object, ...]:
    """All scores that do not depend on the method's processing time."""
    return (tracking.both, tracking.eyes, {name: source.overlap for name, source in tracking.sources.items()})


def _joined(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= _MOST_NAMES else f"{names[0]} and {len(names) - 1} others"


def _tracking_words(method: MethodSequences) -> list[str]:
    tracking = method.tracking.both if method.tracking is not None else None
    if tracking is None or tracking.overlap is None or tracking.losses is None:
        return []
    if tracking.overlap.center_rms_px is None:
        return ["no box in any image that shows the drogue"]
    return [
        f"boxes with an AUC of {three_digits(tracking.overlap.auc)} and {three_digits(tracking.losses.per_minute)} "
        "losses a minute"
    ]


def _filter_words(method: MethodSequences) -> list[str]:
    part = method.filtering
    if part is None or part.motion is None:
        return []
    words = [f"velocity within {millimetres(part.motion.speed_rmse_m_s)} mm/s (RMS)"]
    if part.raw is not None and part.raw.overall.position is not None:
        words.append(f"position errors {three_digits(part.raw.overall.position)} times those of {part.raw.against}")
    return words


def _docking_words(method: MethodSequences) -> list[str]:
    if method.docking is None:
        return []
    return [f"mouth from the probe's tip within {millimetres(method.docking.overall.mouth_rms_m)} mm (RMS)"]


def _latency_words(method: MethodSequences) -> list[str]:
    times = method.latency
    if times is None:
        return []
    late = f"{percent(times.late_fraction)} of the pairs late"
    if times.overall is None:
        return [late]
    median, most = three_digits(times.overall.p50_ms), three_digits(times.overall.p99_ms)
    return [f"median latency {median} ms, 99 % within {most} ms, {late}"]


def _hiding_part(methods: Mapping[str, MethodSequences]) -> ReportPart | None:
    """None where the drogue is never hidden nor comes back."""
    if not any(method.hiding.hidden or method.hiding.reacquisition.n for method in methods.values()):
        return None
    note = (
        "The drogue is hidden where neither image shows a pixel of it, or none of any marker. A pose finds it again "
        "in the first pair in which both images show half of it or more (a delay of 0), or later, if its place errs by "
        "no more than the radius of the rim. Beside the sun it is lost where no pose finds it."
    )
    return ReportPart("hiding", "Losing the drogue", [], [], [hiding_table(methods)], [note])


def _filter_part(
    filters: Mapping[str, FilterErrors], styles: Mapping[str, MethodStyle], result: SequencesResult
) -> ReportPart | None:
    if not filters:
        return None
    bins = {name: part.bins for name, part in filters.items()}
    speed = _lines(bins, lambda row: 1e3 * row.speed_rmse_m_s)
    turn = _lines(bins, lambda row: row.turn_rmse_deg_s)
    panels = [
        distance_lines_panel("motion-speed", "Velocity, RMS error [mm/s]", speed, styles),
        distance_lines_panel("motion-turn", "Rate, RMS error [deg/s]", turn, styles),
    ]
    beyond = millimetres(result.vibration_rms_m_s)
    notes = [
        "True velocity and rate are those of smooth curves through the true poses. The camera's vibration, which pairs "
        f"cannot tell, is left out: it would add {beyond} mm/s (RMS) to the velocity.",
        "Lag is the shift in time that makes estimates agree best with such a curve, apart from a constant error of "
        "each sequence. Where the drogue hardly moves along an axis, it is not known well.",
        "Errors of neighbouring pairs are alike, so means of true covariances scatter more than the range of "
        "independent ones; the interval, Student's over sequences, allows for that. Intervals of lags and of ratios "
        "come from resampled sequences.",
    ]
    return ReportPart(
        "filter", "Motion and filter", _legend(filters, styles), _drawn(panels), filter_tables(filters), notes
    )


def _docking_part(errors: Mapping[str, DockingErrors], styles: Mapping[str, MethodStyle]) -> ReportPart | None:
    if not errors:
        return None
    bins = {name: part.bins for name, part in errors.items()}
    mouth = _lines(bins, lambda row: 1e3 * row.mouth_rms_m)
    closure = _lines(bins, lambda row: None if row.closure_rmse_m_s is None else 1e3 * row.closure_rmse_m_s)
    miss = _lines(bins, lambda row: None if row.miss is None else 1e3 * row.miss.median_absolute_m)
    panels = [
        distance_lines_panel("docking-mouth", "Mouth from the tip, RMS error [mm]", mouth, styles),
        distance_lines_panel("docking-closure", "Closure, RMS error [mm/s]", closure, styles),
        distance_lines_panel("docking-miss", "Predicted miss, median error [mm]", miss, styles),
    ]
    notes = [
        "Axes are the receiver's: forward, right, down. Errors within 1 sd and 2 sd of what was reported should be "
        "68.3 and 95.4 %.",
        "The miss is compared with the one that the true pose and velocity of that instant lead to, straight on and "
        "without a turn, within a minute; beside it with what the sequence later brought, where the tip comes to the "
        "rim.",
    ]
    return ReportPart("docking", "Docking", _legend(errors, styles), _drawn(panels), docking_tables(errors), notes)


def _latency_part(latencies: Mapping[str, Latency], styles: Mapping[str, MethodStyle]) -> ReportPart | None:
    if not latencies:
        return None
    bins = {name: part.bins for name, part in latencies.items()}
    lines = [*_lines(bins, lambda row: row.p50_ms), *_lines(bins, lambda row: row.p99_ms, is_dashed=True)]
    panels = [distance_lines_panel("latency", "Latency, median and (dashed) 99th percentile [ms]", lines, styles)]
    notes = [
        "From the arrival of a pair's images to its estimate, on the machine that made the estimates. A late pair was "
        "not worked on, because newer ones had come; it has no time here, and counts as a pair without a pose "
        "everywhere.",
    ]
    return ReportPart(
        "real-time", "Real time", _legend(latencies, styles), _drawn(panels), latency_tables(latencies), notes
    )


def _lines(
    bins: Mapping[str, Sequence[_Bin]], value: Callable[[_Bin], float | None], is_dashed: bool = False
) -> list[DistanceLine]:
    """A line of each method."""
    return [
        DistanceLine(name, [Point(row.low_m, row.high_m, value(row)) for row in rows], is_dashed)
        for name, rows in bins.items()
    ]


def _legend(names: Iterable[str], styles: Mapping[str, MethodStyle]) -> list[tuple[str, Markup]]:
    return legend_of({name: styles[name] for name in names})


def _drawn(panels: Iterable[str]) -> list[Markup]:
    """Without those that have nothing to show."""
    return [Markup(panel) for panel in panels if panel]
