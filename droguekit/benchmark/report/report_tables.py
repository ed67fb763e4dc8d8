"""The report's tables, as text ready to print."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.report.number_text import (
    ABSENT,
    distance_text,
    interval_text,
    millimetres,
    percent,
    three_digits,
)
from droguekit.benchmark.results.benchmark_result import BenchmarkResult, Row

TITLES = {
    "x": "X, to the right [mm]",
    "y": "Y, down [mm]",
    "z": "Z, depth [mm]",
    "pitch": "Pitch [deg]",
    "yaw": "Yaw [deg]",
}

MOST_OPEN_ROWS = 24
"""A table with more lines is folded: some hundred lines of numbers hide what comes after them."""


@dataclass(frozen=True)
class Group:
    """Rows that share their first cell."""

    label: str
    rows: list[list[str]]


@dataclass(frozen=True)
class Table:
    """A table whose first two columns are the group's label and the row's name.

    Attributes:
        first, second: what these two are.
    """

    anchor: str
    title: str
    columns: list[str]
    groups: list[Group]
    first: str = "distance"
    second: str = "method"

    @property
    def row_count(self) -> int:
        """Lines of all groups together."""
        return sum(len(group.rows) for group in self.groups)

    @property
    def is_long(self) -> bool:
        """Whether it would fill a screen, and is folded under its title."""
        return self.row_count > MOST_OPEN_ROWS


def overall_table(result: BenchmarkResult) -> Table:
    """One row a method, over all distances."""
    columns = ["pairs", "pose found", "95 % interval", "mean", "95 % interval", "RMS", "transverse RMS", "p95", "p99"]
    columns += ["max", "false poses"]
    rows = []
    for name, method in result.methods.items():
        row, empty = method.overall, method.empty_frames
        ends = row.intervals["fix_fraction"]
        rows.append(
            [
                name,
                str(row.n),
                percent(row.fix_fraction),
                f"{percent(round(ends[0], 3))} to {percent(round(ends[1], 3))}",
                millimetres(row.position_mean_m),
                interval_text(row.intervals.get("position_mean_m"), 1e3),
                *map(millimetres, (row.position_rmse_m, row.transverse_rmse_m, row.position_p95_m)),
                *map(millimetres, (row.position_p99_m, row.position_max_m)),
                f"{empty.false_fixes} of {empty.n}",
            ]
        )
    return Table("overall", "All distances: position error [mm]", columns, [Group("all", rows)])


def position_table(result: BenchmarkResult) -> Table:
    """Position error by distance and method."""
    columns = ["pairs", "pose found", "mean", "95 % interval", "RMS", "95 % interval", "transverse RMS", "p95", "p99"]
    columns += ["max", "bound"]

    def cells(row: Row) -> list[str]:
        return [
            str(row.n),
            percent(row.fix_fraction),
            millimetres(row.position_mean_m),
            interval_text(row.intervals.get("position_mean_m"), 1e3),
            millimetres(row.position_rmse_m),
            interval_text(row.intervals.get("position_rmse_m"), 1e3),
            *map(millimetres, (row.transverse_rmse_m, row.position_p95_m, row.position_p99_m, row.position_max_m)),
            millimetres(row.bound.position_m if row.bound else None),
        ]

    return Table("position", "Position error [mm]", columns, _by_distance(result, cells))


def component_tables(result: BenchmarkResult) -> list[Table]:
    """One table for each component of the pose."""
    return [_component_table(result, name) for name in COMPONENTS]


def centroid_table(result: BenchmarkResult) -> Table:
    """What each method's centroids are worth, and how much of its position error they explain."""
    columns = ["centroids", "RMS", "bias right", "bias down", "bias outward", "hub RMS", "mistaken"]
    columns += ["position from centroids [mm]", "share"]

    def cells(row: Row) -> list[str]:
        c = row.centroids
        biases = (c.bias_u_px, c.bias_v_px, c.bias_outward_px)
        return [
            str(c.count),
            *map(three_digits, (c.sigma_px, *biases, c.hub_sigma_px)),
            str(c.mistaken),
            millimetres(row.position_from_centroids_rmse_m),
            percent(None if row.centroid_share is None else round(row.centroid_share, 3)),
        ]

    return Table(
        "centroids", "Marker centroids against the true ellipse centres [px]", columns, _by_distance(result, cells)
    )


def rangefinder_tables(result: BenchmarkResult) -> list[Table]:
    """Depth errors as an experiment with a rangefinder sees them, beside the true ones; none without readings."""
    names = [name for name, method in result.methods.items() if method.overall.rangefinder is not None]
    if not names:
        return []
    columns = ["pairs", "RMS against reading", "mean against reading", "of the distance"]
    columns += ["RMS against truth", "mean against truth", "of the distance", "reading against truth, RMS", "bias"]

    def cells(row: Row) -> list[str]:
        found = row.rangefinder
        if found is None:
            return ["0", *[ABSENT] * (len(columns) - 1)]
        sides = (found.against_reading, found.against_truth)
        both = [
            text
            for side in sides
            for text in (
                millimetres(side.rmse_m),
                millimetres(side.mean_absolute_m),
                f"{three_digits(100 * side.mean_absolute_fraction)} %",
            )
        ]
        return [str(found.n), *both, millimetres(found.reading.rmse_m), millimetres(found.reading.bias_m)]

    title = "Depth against the rangefinder's reading and against the truth [mm]"
    return [Table("rangefinder", title, columns, with_overall(result, names, cells))]


def _component_table(result: BenchmarkResult, name: str) -> Table:
    unit = "deg" if name in ("pitch", "yaw") else "m"
    scale = 1.0 if unit == "deg" else 1e3

    def shown(row: Row, key: str) -> str:
        value = row.value(f"{name}_{key}_{unit}")
        return three_digits(None if value is None else value * scale)

    def ends(row: Row, key: str) -> str:
        return interval_text(row.intervals.get(f"{name}_{key}_{unit}"), scale)

    def cells(row: Row) -> list[str]:
        bound = getattr(row.bound, f"{name}_{unit}") * scale if row.bound else None
        ratio = getattr(row.bound_ratio, name) if row.bound_ratio else None
        return [
            str(row.fixes),
            shown(row, "rmse"),
            ends(row, "rmse"),
            shown(row, "bias"),
            ends(row, "bias"),
            *(shown(row, key) for key in ("p95", "p99", "max")),
            three_digits(bound),
            three_digits(ratio),
        ]

    columns = ["poses", "RMS", "95 % interval", "bias", "95 % interval", "p95", "p99", "max", "bound", "RMS / bound"]
    return Table(name, TITLES[name], columns, _by_distance(result, cells))


def with_overall(result: BenchmarkResult, names: Sequence[str], cells: Callable[[Row], list[str]]) -> list[Group]:
    """A group over all distances and one for each bin, with a row for each of the named methods."""
    groups = [Group("all", [[name, *cells(result.methods[name].overall)] for name in names])]
    for k, place in enumerate(result.reference):
        rows = [[name, *cells(result.methods[name].bins[k])] for name in names]
        groups.append(Group(distance_text(place.low_m, place.high_m), rows))
    return groups


def _by_distance(result: BenchmarkResult, cells: Callable[[Row], list[str]]) -> list[Group]:
    return with_overall(result, list(result.methods), cells)[1:]
