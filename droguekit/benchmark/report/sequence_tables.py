"""The report's tables of motion, docking quantities and latency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.report.number_text import (
    ABSENT,
    distance_text,
    interval_text,
    millimetres,
    percent,
    three_digits,
)
from droguekit.benchmark.report.report_tables import Group, Table
from droguekit.benchmark.report.tracking_tables import REACQUISITION_COLUMNS, reacquisition_cells
from droguekit.benchmark.results.docking_result import Calibration, Captures, DockingErrors, DockingRow, MissRow
from droguekit.benchmark.results.result_parts import BinRatios, MeanRatios, NeesPart
from droguekit.benchmark.results.sequence_result import (
    Filtering,
    Latency,
    MethodSequences,
    MotionBin,
    MotionRow,
    Percentiles,
)

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
    return Table("hiding", "Poses while the drogue is hidden, and after", columns, [Group("all", rows)], "sequences")


def filter_tables(filters: Mapping[str, Filtering]) -> list[Table]:
    """Motion, its covariances, lag, and errors beside the raw method's."""
    motion = {name: (part.motion, part.bins) for name, part in filters.items() if part.motion is not None}
    return [
        *([_motion_table(motion)] if motion else []),
        _nees_table(filters),
        _lag_table(filters),
        *_raw_tables(filters),
    ]


def docking_tables(errors: Mapping[str, DockingErrors]) -> list[Table]:
    """The place of the mouth, what is ahead, and captures."""
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
        Group(name, [[stage, *_time_cells(times)] for stage, times in part.stages.items()])
        for name, part in latencies.items()
        if part.stages
    ]
    tables = [
        Table("latency", "From the arrival of the images to the answer [ms]", columns, _by_distance(rows, _time_cells)),
        Table("late", "Pairs that were not worked on", ["pairs", "late", "share"], [Group("all", late)], "sequences"),
    ]
    if stages:
        tables.append(Table("stages", "The stages [ms]", columns, stages, "method", "stage"))
    return tables


def _by_distance(
    rows: Mapping[str, tuple[_Row, Sequence[_Bin]]], cells: Callable[[_Row | _Bin], list[str]]
) -> list[Group]:
    """A group over all distances and one for each bin that any method has."""
    groups = {"all": [[name, *cells(overall)] for name, (overall, _) in rows.items()]}
    for low_m, high_m in sorted({(row.low_m, row.high_m) for _, bins in rows.values() for row in bins}):
        groups[distance_text(low_m, high_m)] = [
            [name, *cells(row)] for name, (_, bins) in rows.items() for row in bins if row.low_m == low_m
        ]
    return [Group(label, lines) for label, lines in groups.items()]


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


def _nees_table(filters: Mapping[str, Filtering]) -> Table:
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
    return Table("motion-nees", title, columns, [Group("all", rows)])


def _lag_table(filters: Mapping[str, Filtering]) -> Table:
    rows = []
    for name, part in filters.items():
        cells = []
        for component in COMPONENTS:
            lag = part.lags[component] if part.lags is not None else None
            cells.append(millimetres(lag.lag_s if lag is not None else None))
            cells.append(interval_text(lag.interval if lag is not None else None, 1e3))
        rows.append([name, *cells])
    columns = [cell for name in ("X", "Y", "Z", "pitch", "yaw") for cell in (name, "95 % interval")]
    return Table("lag", "Lag behind the truth [ms]", columns, [Group("all", rows)])


def _raw_tables(filters: Mapping[str, Filtering]) -> list[Table]:
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
    return [Table("captures", "Captures called and true", columns, [Group("all", rows)])] if rows else []


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


def _time_cells(row: Percentiles | None) -> list[str]:
    if row is None:
        return ["0", *[ABSENT] * 4]
    return [str(row.n), *map(three_digits, (row.p50_ms, row.p95_ms, row.p99_ms, row.max_ms))]
