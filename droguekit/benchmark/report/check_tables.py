"""The report's tables of errors against bounds and covariances, mirrored tilts, failures, and methods side by side."""

from __future__ import annotations

from collections.abc import Sequence

from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.report.number_text import distance_text, interval_text, millimetres, percent, three_digits
from droguekit.benchmark.report.report_tables import Group, Table, with_overall
from droguekit.benchmark.results.benchmark_result import BenchmarkResult, Row
from droguekit.benchmark.results.result_parts import Comparison, Flips, MeanRatios, NeesPart, NormalizedErrors

_NAMES = {"x": "X", "y": "Y", "z": "Z", "pitch": "pitch", "yaw": "yaw"}


def check_tables(result: BenchmarkResult) -> list[Table]:
    """All of them; those that would say nothing are left out."""
    return [
        *comparison_tables(result),
        normalized_table(result, "normalized", "Error over the bound of all features, pair by pair"),
        normalized_table(result, "normalized_own", "Error over the bound of the method's own features and noise"),
        *nees_tables(result),
        flip_table(result),
        failure_table(result),
    ]


def normalized_table(result: BenchmarkResult, key: str, title: str) -> Table:
    """Normalized errors of every component with their upper limits; `key` is that of the row."""

    def cells(row: Row) -> list[str]:
        errors: NormalizedErrors | None = getattr(row, key)
        if errors is None:
            return ["0"] + [three_digits(None)] * (2 * len(COMPONENTS))
        shown = [str(errors.n)]
        for name in COMPONENTS:
            shown += [three_digits(getattr(errors.nrms, name)), three_digits(getattr(errors.upper, name))]
        return shown

    columns = ["poses"]
    for name in COMPONENTS:
        columns += [_NAMES[name], "95 % limit"]
    return Table(key.replace("_", "-"), title, columns, with_overall(result, list(result.methods), cells))


def nees_tables(result: BenchmarkResult) -> list[Table]:
    """How well errors fit the reported covariances, for the methods that report any."""
    names = [name for name, method in result.methods.items() if method.overall.nees is not None]
    if not names:
        return []

    def cells(row: Row) -> list[str]:
        if row.nees is None:
            return ["0", *[three_digits(None)] * 6, "0"]
        parts = [_nees_cells(part) for part in (row.nees.position, row.nees.attitude, row.nees.pose)]
        return [str(row.nees.n), *(cell for part in parts for cell in part), str(row.nees.unusable)]

    columns = ["poses"]
    for name in ("position", "attitude", "all five"):
        columns += [name, "95 % of true ones"]
    columns.append("unusable")
    title = "Squared error over the reported covariance and the degrees of freedom (NEES)"
    return [Table("nees", title, columns, with_overall(result, names, cells))]


def flip_table(result: BenchmarkResult) -> Table:
    """Mirrored tilts, and what the flip law expects."""

    def cells(row: Row) -> list[str]:
        return _flip_cells(row.flips) + _flip_cells(row.sight_flips)

    columns = ["clear tilts", "mirrored", "share", "95 % interval", "law"]
    columns += ["clear by sight", "mirrored", "share", "95 % interval", "law"]
    return Table("flips", "Mirrored tilts", columns, with_overall(result, list(result.methods), cells))


def failure_table(result: BenchmarkResult) -> Table:
    """Pairs without a pose, and errors that count them."""

    def cells(row: Row) -> list[str]:
        errors = row.rmse_with_failures
        lengths = (errors.x_m, errors.y_m, errors.z_m)
        angles = (errors.pitch_deg, errors.yaw_deg)
        return [str(row.n), str(row.failures), *map(millimetres, lengths), *map(three_digits, angles)]

    columns = ["pairs", "failures", "X [mm]", "Y [mm]", "Z [mm]", "pitch [deg]", "yaw [deg]"]
    title = "Failures, and RMS errors that count each as a guess"
    return Table("failures", title, columns, with_overall(result, list(result.methods), cells))


def comparison_tables(result: BenchmarkResult) -> list[Table]:
    """One table for each method that the others are compared with."""
    tables = []
    for number, other in enumerate(dict.fromkeys(pair.against for pair in result.comparisons)):
        pairs = [pair for pair in result.comparisons if pair.against == other]
        title = f"Mean error over that of {other}, on the pairs in which both found a pose"
        columns = ["pairs", "position", "95 % interval", "pitch and yaw", "95 % interval"]
        tables.append(Table(f"against-{number}", title, columns, _comparison_groups(result, pairs)))
    return tables


def _comparison_groups(result: BenchmarkResult, pairs: Sequence[Comparison]) -> list[Group]:
    groups = [Group("all", [[pair.method, *_ratio_cells(pair.overall)] for pair in pairs])]
    for k, place in enumerate(result.reference):
        rows = [[pair.method, *_ratio_cells(pair.bins[k])] for pair in pairs]
        groups.append(Group(distance_text(place.low_m, place.high_m), rows))
    return groups


def _ratio_cells(ratios: MeanRatios) -> list[str]:
    return [
        str(ratios.n),
        three_digits(ratios.position),
        interval_text(ratios.position_interval),
        three_digits(ratios.attitude),
        interval_text(ratios.attitude_interval),
    ]


def _nees_cells(part: NeesPart | None) -> list[str]:
    if part is None:
        return [three_digits(None)] * 2
    return [three_digits(part.per_freedom), interval_text((part.low, part.high))]


def _flip_cells(flips: Flips) -> list[str]:
    ends = flips.interval
    return [
        str(flips.n),
        str(flips.flips),
        _share(flips.rate),
        three_digits(None) if ends is None else f"{_share(ends[0])} to {_share(ends[1])}",
        _share(flips.predicted),
    ]


def _share(fraction: float | None) -> str:
    return percent(None if fraction is None else round(fraction, 3))
