"""Tables of the report about sequences as text: tracking, motion, docking quantities, latency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

from droguekit.scoring.poses.pose_errors import COMPONENTS
from droguekit.scoring.report.html_page import RowGroup, Table
from droguekit.scoring.report.number_text import (
    ABSENT,
    distance_text,
    interval_text,
    millimetres,
    percent,
    plain_number,
    three_digits,
)
from droguekit.scoring.results.pose_result import BinRatios, MeanRatios, NeesPart
from droguekit.scoring.results.sequence_result import (
    Calibration,
    Captures,
    DockingErrors,
    DockingRow,
    EyeTracking,
    FilterErrors,
    Latency,
    MethodSequences,
    MissRow,
    MotionBin,
    MotionRow,
    OverlapRow,
    Reacquisition,
    SourceTracking,
    TimePercentiles,
    Tracking,
    TrackLosses,
)

_OVERLAP_COLUMNS = ["images", "AUC", "95 % interval", "mean overlap", "within 20 px", "95 % interval"]
_OVERLAP_COLUMNS += ["normalised precision", "centres, RMS [px]"]
REACQUISITION_COLUMNS = ["re-appearances", "found again", "within 3 frames", "median delay [frames]", "longest"]


def reacquisition_cells(row: Reacquisition) -> list[str]:
    """In the columns of `REACQUISITION_COLUMNS`."""
    delays = (ABSENT, ABSENT) if row.median_frames is None else (plain_number(row.median_frames), str(row.max_frames))
    return [str(row.n), str(row.found), str(row.within_3), *delays]


def tracking_tables(trackings: Mapping[str, Tracking], first: str) -> list[Table]:
    """Overlaps, by source of the box, and losses; `first` is what the names are."""
    return [_overlap_table(trackings, first), *_source_tables(trackings, first), _loss_table(trackings, first)]


def _overlap_table(trackings: Mapping[str, Tracking], first: str) -> Table:
    groups = [
        RowGroup(name, [[label, *_overlap_cells(row.overlap)] for label, row in _by_eye(tracking)])
        for name, tracking in trackings.items()
    ]
    return Table("overlap", "Boxes against the true ones (OTB)", _OVERLAP_COLUMNS, groups, first, "eye")


def _source_tables(trackings: Mapping[str, Tracking], first: str) -> list[Table]:
    """By source of the box; none where no box names its source."""
    groups = [
        RowGroup(name, [[source, *_source_cells(row)] for source, row in tracking.sources.items()])
        for name, tracking in trackings.items()
        if tracking.sources
    ]
    columns = ["pairs", *_OVERLAP_COLUMNS, "box, median [ms]", "whole pair", "p95"]
    return [Table("sources", "The same by source of the box", columns, groups, first, "source")] if groups else []


def _loss_table(trackings: Mapping[str, Tracking], first: str) -> Table:
    groups = [
        RowGroup(name, [[label, *_loss_cells(row)] for label, row in _by_eye(tracking)])
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


def _rate_cells(losses: TrackLosses | None) -> list[str]:
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


Methods = Mapping[str, MethodSequences]


class _Place(Protocol):
    @property
    def low_m(self) -> float: ...
    @property
    def high_m(self) -> float: ...


_Row = TypeVar("_Row")
_Bin = TypeVar("_Bin", bound=_Place)


def hiding_table(methods: Methods) -> Table:
    """Poses while the drogue is hidden, and how soon they come again."""
    rows = [
        [
            name,
            str(method.hiding.hidden),
            str(method.hiding.poses_while_hidden),
            *reacquisition_cells(method.hiding.reacquisition),
        ]
        for name, method in methods.items()
    ]
    columns = ["pairs without the drogue", "poses in them", *REACQUISITION_COLUMNS]
    return Table("hiding", "Poses while the drogue is hidden, and after", columns, [RowGroup("all", rows)], "sequences")


def filter_tables(filters: Mapping[str, FilterErrors]) -> list[Table]:
    """Motion, its covariances, lag, and errors relative to the unfiltered method."""
    motion = {name: (part.motion, part.bins) for name, part in filters.items() if part.motion is not None}
    return [
        *([_motion_table(motion)] if motion else []),
        _nees_table(filters),
        _lag_table(filters),
        *_raw_tables(filters),
    ]


def docking_tables(errors: Mapping[str, DockingErrors]) -> list[Table]:
    """Position of the mouth, closure and predicted miss, and captures."""
    rows = {name: (part.overall, part.bins) for name, part in errors.items()}
    mouth = ["pairs", "of", "forward", "right", "down", "length", "95 % interval", "bias forward", "right", "down"]
    within = [cell for name in ("forward", "right", "down", "miss") for cell in (f"{name} within 1 sd", "2 sd")]
    ahead = ["pairs", "closure, RMS [mm/s]", "bias", "contact, median size [s]", "pairs with a miss"]
    ahead += ["median size [mm]", "p95", "RMS", "bias", "pairs with an end", "median size [mm]"]
    title = "Mouth from the probe's tip, RMS errors along body axes [mm]"
    return [
        Table("mouth", title, mouth, _by_distance(rows, _mouth_cells)),
        Table("miss", "Closure and predicted miss, estimate minus truth", ahead, _by_distance(rows, _ahead_cells)),
        Table("calibration", "Errors within their standard deviations", within, _by_distance(rows, _within_cells)),
        *_capture_tables(errors),
    ]


def latency_tables(latencies: Mapping[str, Latency]) -> list[Table]:
    """Whole and by distance, and by stage."""
    rows = {name: (part.overall, part.bins) for name, part in latencies.items()}
    columns = ["pairs", "median", "p95", "p99", "longest"]
    late = [
        [name, str(part.answers), str(part.late), percent(round(part.late_fraction, 4))]
        for name, part in latencies.items()
    ]
    stages = [
        RowGroup(name, [[stage, *_time_cells(times)] for stage, times in part.stages.items()])
        for name, part in latencies.items()
        if part.stages
    ]
    tables = [
        Table(
            "latency", "From the arrival of the images to the estimate [ms]", columns, _by_distance(rows, _time_cells)
        ),
        Table("late", "Pairs that were skipped", ["pairs", "late", "share"], [RowGroup("all", late)], "sequences"),
    ]
    if stages:
        tables.append(Table("stages", "The stages [ms]", columns, stages, "method", "stage"))
    return tables


def _by_distance(
    rows: Mapping[str, tuple[_Row, Sequence[_Bin]]], cells: Callable[[_Row | _Bin], list[str]]
) -> list[RowGroup]:
    """A group over all distances and one for each bin that any method has."""
    groups = {"all": [[name, *cells(overall)] for name, (overall, _) in rows.items()]}
    for low_m, high_m in sorted({(row.low_m, row.high_m) for _, bins in rows.values() for row in bins}):
        groups[distance_text(low_m, high_m)] = [
            [name, *cells(row)] for name, (_, bins) in rows.items() for row in bins if row.low_m == low_m
        ]
    return [RowGroup(label, lines) for label, lines in groups.items()]


def _motion_table(rows: Mapping[str, tuple[MotionRow, Sequence[MotionBin]]]) -> Table:
    columns = ["pairs", "of", "velocity X [mm/s]", "Y", "Z", "length", "95 % interval"]
    columns += ["rate X [deg/s]", "Y", "Z", "length", "95 % interval"]

    def cells(row: MotionRow) -> list[str]:
        velocity, rate = row.velocity_rmse_m_s, row.rate_rmse_deg_s
        return [
            str(row.n),
            str(row.of),
            *map(millimetres, (velocity.x, velocity.y, velocity.z, row.speed_rmse_m_s)),
            interval_text(row.speed_interval, 1e3),
            *map(three_digits, (rate.x, rate.y, rate.z, row.turn_rmse_deg_s)),
            interval_text(row.turn_interval),
        ]

    return Table("motion", "Velocity and rate, RMS errors", columns, _by_distance(rows, cells))


def _nees_table(filters: Mapping[str, FilterErrors]) -> Table:
    columns = ["pairs", "velocity", "95 % of true ones", "rate", "95 % of true ones", "all six", "95 % of true ones"]
    columns += ["95 % interval", "unusable"]
    rows = []
    for name, part in filters.items():
        nees = part.nees
        if nees is None:
            rows.append([name, "0", *[ABSENT] * 7, "0"])
        else:
            parts = [cell for one in (nees.velocity, nees.rate, nees.motion) for cell in _nees_cells(one)]
            rows.append([name, str(nees.n), *parts, interval_text(nees.interval), str(nees.unusable)])
    title = "Squared error of the motion over its covariance and the degrees of freedom (NEES)"
    return Table("motion-nees", title, columns, [RowGroup("all", rows)])


def _lag_table(filters: Mapping[str, FilterErrors]) -> Table:
    rows = []
    for name, part in filters.items():
        cells = []
        for component in COMPONENTS:
            lag = part.lags[component] if part.lags is not None else None
            cells.append(millimetres(lag.lag_s if lag is not None else None))
            cells.append(interval_text(lag.interval if lag is not None else None, 1e3))
        rows.append([name, *cells])
    columns = [cell for name in ("X", "Y", "Z", "pitch", "yaw") for cell in (name, "95 % interval")]
    return Table("lag", "Lag behind the truth [ms]", columns, [RowGroup("all", rows)])


def _raw_tables(filters: Mapping[str, FilterErrors]) -> list[Table]:
    compared = {name: part.raw for name, part in filters.items() if part.raw is not None}
    if not compared:
        return []
    rows: dict[str, tuple[MeanRatios, Sequence[BinRatios]]] = {
        f"{name} / {pair.against}": (pair.overall, pair.bins) for name, pair in compared.items()
    }

    def cells(row: MeanRatios) -> list[str]:
        ends = (interval_text(row.position_interval), interval_text(row.attitude_interval))
        return [str(row.n), three_digits(row.position), ends[0], three_digits(row.attitude), ends[1]]

    columns = ["pairs", "position", "95 % interval", "pitch and yaw", "95 % interval"]
    title = "Mean error over that of the poses that went in, on the pairs in which both have one"
    return [Table("raw", title, columns, _by_distance(rows, cells))]


def _mouth_cells(row: DockingRow) -> list[str]:
    size, bias = row.mouth_rmse_m, row.mouth_bias_m
    return [
        str(row.n),
        str(row.of),
        *map(millimetres, (size.forward, size.right, size.down, row.mouth_rms_m)),
        interval_text(row.mouth_interval, 1e3),
        *map(millimetres, (bias.forward, bias.right, bias.down)),
    ]


def _within_cells(row: DockingRow) -> list[str]:
    axes = [row.calibration[axis] for axis in ("forward", "right", "down")]
    miss = None if row.miss is None else row.miss.calibration
    return [cell for found in (*axes, miss) for cell in _calibration_cells(found)]


def _ahead_cells(row: DockingRow) -> list[str]:
    miss, end = row.miss, row.miss_in_the_end
    return [
        str(row.n),
        millimetres(row.closure_rmse_m_s),
        millimetres(row.closure_bias_m_s),
        three_digits(row.contact_median_absolute_s),
        *_miss_cells(miss),
        *(("0", ABSENT) if end is None else (str(end.n), millimetres(end.median_absolute_m))),
    ]


def _miss_cells(miss: MissRow | None) -> list[str]:
    if miss is None:
        return ["0", *[ABSENT] * 4]
    lengths = (miss.median_absolute_m, miss.p95_m, miss.rmse_m, miss.bias_m)
    return [str(miss.n), *map(millimetres, lengths)]


def _capture_tables(errors: Mapping[str, DockingErrors]) -> list[Table]:
    rows = []
    for name, part in errors.items():
        for label, found in (("as predicted", part.overall.captures), ("in the end", part.overall.captures_in_the_end)):
            if found is not None:
                rows.append([f"{name}, {label}", *_capture_cells(found)])
    columns = ["radius [mm]", "rightly yes", "wrongly yes", "wrongly no", "rightly no"]
    return [Table("captures", "Captures called and true", columns, [RowGroup("all", rows)])] if rows else []


def _capture_cells(found: Captures) -> list[str]:
    counts = (found.true_yes, found.false_yes, found.false_no, found.true_no)
    return [millimetres(found.radius_m), *map(str, counts)]


def _calibration_cells(found: Calibration | None) -> list[str]:
    if found is None:
        return [ABSENT, ABSENT]
    return [percent(round(found.within_1, 3)), percent(round(found.within_2, 3))]


def _nees_cells(part: NeesPart | None) -> list[str]:
    if part is None:
        return [ABSENT, ABSENT]
    return [three_digits(part.per_freedom), interval_text((part.low, part.high))]


def _time_cells(row: TimePercentiles | None) -> list[str]:
    if row is None:
        return ["0", *[ABSENT] * 4]
    return [str(row.n), *map(three_digits, (row.p50_ms, row.p95_ms, row.p99_ms, row.max_ms))]
