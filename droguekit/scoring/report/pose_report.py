"""The benchmark as one HTML page that needs nothing from outside: no network, no script, no other file.

Its tables as text come first: errors, bounds, covariances, mirrored tilts, failures, methods compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import read_estimates
from drogue_models.marker_layout import marker_layout
from droguekit.scoring.poses.method_scores import best_method
from droguekit.scoring.poses.pose_errors import COMPONENTS
from droguekit.scoring.report.figures import FEW_METHODS, QUANTITIES, error_panel, legend_key, method_styles
from droguekit.scoring.report.html_page import RowGroup, Table, page_template
from droguekit.scoring.report.label_drawing import contact_tiles
from droguekit.scoring.report.number_text import (
    ABSENT,
    distance_text,
    interval_text,
    millimetres,
    percent,
    plain_number,
    three_digits,
)
from droguekit.scoring.report.sequence_report import sequence_section
from droguekit.scoring.results.benchmark_result import BenchmarkResult, PoseBin, PoseRow
from droguekit.scoring.results.pose_result import Flips, MeanRatios, MethodComparison, NeesPart, NormalizedErrors
from droguekit.scoring.sequences.sequence_latency import processing_time_s

TITLES = {
    "x": "X, to the right [mm]",
    "y": "Y, down [mm]",
    "z": "Z, depth [mm]",
    "pitch": "Pitch [deg]",
    "yaw": "Yaw [deg]",
}


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
    return Table("overall", "All distances: position error [mm]", columns, [RowGroup("all", rows)])


def position_table(result: BenchmarkResult) -> Table:
    """Position error by distance and method."""
    columns = ["pairs", "pose found", "mean", "95 % interval", "RMS", "95 % interval", "transverse RMS", "p95", "p99"]
    columns += ["max", "bound"]

    def cells(row: PoseRow) -> list[str]:
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
    """Errors of each method's centroids, and how much of its position error they explain."""
    columns = ["centroids", "RMS", "bias right", "bias down", "bias outward", "hub RMS", "mistaken"]
    columns += ["position from centroids [mm]", "share"]

    def cells(row: PoseRow) -> list[str]:
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
    """Depth errors against the rangefinder's readings and against the truth; none without readings."""
    names = [name for name, method in result.methods.items() if method.overall.rangefinder is not None]
    if not names:
        return []
    columns = ["pairs", "RMS against reading", "mean against reading", "of the distance"]
    columns += ["RMS against truth", "mean against truth", "of the distance", "reading against truth, RMS", "bias"]

    def cells(row: PoseRow) -> list[str]:
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

    def shown(row: PoseRow, key: str) -> str:
        value = row.value(f"{name}_{key}_{unit}")
        return three_digits(None if value is None else value * scale)

    def ends(row: PoseRow, key: str) -> str:
        return interval_text(row.intervals.get(f"{name}_{key}_{unit}"), scale)

    def cells(row: PoseRow) -> list[str]:
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


def with_overall(
    result: BenchmarkResult, names: Sequence[str], cells: Callable[[PoseRow], list[str]]
) -> list[RowGroup]:
    """A group over all distances and one for each bin, with a row for each of the named methods."""
    groups = [RowGroup("all", [[name, *cells(result.methods[name].overall)] for name in names])]
    for k, place in enumerate(result.reference):
        rows = [[name, *cells(result.methods[name].bins[k])] for name in names]
        groups.append(RowGroup(distance_text(place.low_m, place.high_m), rows))
    return groups


def _by_distance(result: BenchmarkResult, cells: Callable[[PoseRow], list[str]]) -> list[RowGroup]:
    return with_overall(result, list(result.methods), cells)[1:]


_NAMES = {"x": "X", "y": "Y", "z": "Z", "pitch": "pitch", "yaw": "yaw"}


def check_tables(result: BenchmarkResult) -> list[Table]:
    """Tables of consistency checks; tables without content are left out."""
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

    def cells(row: PoseRow) -> list[str]:
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

    def cells(row: PoseRow) -> list[str]:
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

    def cells(row: PoseRow) -> list[str]:
        return _flip_cells(row.flips) + _flip_cells(row.sight_flips)

    columns = ["clear tilts", "mirrored", "share", "95 % interval", "law"]
    columns += ["clear by sight", "mirrored", "share", "95 % interval", "law"]
    return Table("flips", "Mirrored tilts", columns, with_overall(result, list(result.methods), cells))


def failure_table(result: BenchmarkResult) -> Table:
    """Pairs without a pose, and errors that count them."""

    def cells(row: PoseRow) -> list[str]:
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


def _comparison_groups(result: BenchmarkResult, pairs: Sequence[MethodComparison]) -> list[RowGroup]:
    groups = [RowGroup("all", [[pair.method, *_ratio_cells(pair.overall)] for pair in pairs])]
    for k, place in enumerate(result.reference):
        rows = [[pair.method, *_ratio_cells(pair.bins[k])] for pair in pairs]
        groups.append(RowGroup(distance_text(place.low_m, place.high_m), rows))
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


def write_report(
    dataset: Location, estimates: Path, result: BenchmarkResult, out_html: Path, faults: PairFaults | None = None
) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        dataset: the dataset's folder, for its facts and pictures.
        estimates: the file that was scored, for the times that its methods took.
        result: of `run_benchmark` for both.
        out_html: where to write.
        faults: count pairs whose picture cannot be shown; without, such a pair is an error.

    Raises:
        ValueError: dataset or estimates cannot be read, or the result is of another dataset.
        OSError: the page cannot be written.
    """
    data = Dataset(dataset)
    if data.manifest.dataset_sha256 != result.dataset.sha256:
        raise ValueError(
            f"{dataset}: is not the dataset of this result, whose hash begins {result.dataset.sha256[:12]}"
        )
    styles = method_styles(list(result.methods))
    times = stage_times_table(estimates)
    found = [row for method in result.methods.values() for row in method.bins if row.fixes]
    has_bound = any(place.bound is not None for place in result.reference)
    bound = [("Cramér–Rao bound", Markup(legend_key(None)))] if has_bound else []
    page = page_template("pose_report.html.j2").render(
        result=result,
        sentences=result_sentences(result),
        facts=dataset_facts(data.manifest, estimates.name),
        tiles=[(tile, plain_number(tile.distance_m)) for tile in contact_tiles(data, faults=faults)],
        panels=[Markup(error_panel(result, quantity)) for quantity in QUANTITIES] if found else [],
        has_zeros=any(row.value(quantity.key) == 0 for row in found for quantity in QUANTITIES),
        legend=[(name, Markup(legend_key(style))) for name, style in styles.items()] + bound,
        many_methods=len(styles) > FEW_METHODS,
        tables=[
            overall_table(result),
            position_table(result),
            *component_tables(result),
            *rangefinder_tables(result),
            *check_tables(result),
            centroid_table(result),
            *([] if times is None else [times]),
        ],
        has_readings=any(method.overall.rangefinder is not None for method in result.methods.values()),
        sequences=None if result.sequences is None else sequence_section(result.sequences, styles),
    )
    write_text_atomic(out_html, page)


def result_sentences(result: BenchmarkResult) -> list[str]:
    """The result in plain sentences, computed from the numbers."""
    low, high = (plain_number(end) for end in (result.reference[0].low_m, result.reference[-1].high_m))
    shown = sum(place.n for place in result.reference)
    best = best_method(result.methods)
    if best is None:
        return [f"None of the methods found a pose in any of the {shown} pairs, from {low} to {high} m."]
    method = result.methods[best]
    ends = method.overall.intervals.get("position_mean_m")
    within = "" if ends is None else f" (95 % interval {interval_text(ends, 1e3)} mm)"
    sentences = [
        f"Over {shown} stereo pairs from {low} to {high} m, {best} came closest to the truth: its mean position error "
        f"is {millimetres(method.overall.position_mean_m)} mm{within}, and it found a pose in "
        f"{percent(method.overall.fix_fraction)} of the pairs."
    ]
    fixed = [row for row in method.bins if row.fixes]
    sentences += [_at(row) for row in (fixed[0], fixed[-1])[: len(fixed)]]
    sentences += _against_bound(result, best)
    empty = method.empty_frames
    if empty.n:
        sentences.append(f"It reported a pose in {empty.false_fixes} of {empty.n} pairs without a drogue.")
    return sentences + _others(result, best)


def dataset_facts(manifest: Manifest, estimates_name: str) -> list[tuple[str, str]]:
    """Facts of the dataset, as pairs of a name and a value."""
    recipe = manifest.recipe
    camera, layout = recipe.rig.camera, marker_layout(recipe.drogue)
    markers = f"{layout.count} markers of {plain_number(200 * layout.radius_m)} cm diameter"
    if layout.ring_radius_m is not None:
        markers += f" on a ring of {plain_number(layout.ring_radius_m)} m radius"
    hub = "no hub feature"
    if layout.hub_center_m is not None:
        hub = f"hub annulus {plain_number(layout.hub_center_m[2])} m behind the rim plane"
    empty = f", {manifest.counts.empty} of them without a drogue" if manifest.counts.empty else ""
    return [
        ("Dataset", recipe.name),
        ("Description", recipe.description or "none"),
        ("Content hash (SHA-256)", manifest.dataset_sha256),
        ("Stereo pairs", f"{manifest.counts.pairs}{empty}"),
        (
            "Rig",
            f"two cameras of {camera.width_px} × {camera.height_px} px, focal length {camera.fx_px:.1f} px, "
            f"baseline {plain_number(recipe.rig.baseline_m)} m",
        ),
        ("Sensor", f"{recipe.sensor.name}, {recipe.sensor.output_bits} bit, {recipe.sensor.encoding}"),
        ("Drogue", f"{recipe.drogue.name}: {markers}, {hub}"),
        ("Rendered by", ", ".join(sorted(manifest.engines)) or "nothing"),
        ("Seed", str(recipe.seed)),
        ("Estimates", estimates_name),
    ]


def stage_times_table(estimates: Path) -> Table | None:
    """Median time for a pair by method: total without waiting, and the stages. [ms]

    Pairs on which no time was spent, and methods that report none, are left out; None without any.
    """
    stages: dict[str, dict[str, list[float]]] = {}
    for estimate in read_estimates(estimates):
        work_s = processing_time_s(estimate.stage_s)
        if work_s is None:
            continue
        for stage, seconds in {**estimate.stage_s, "": work_s}.items():
            stages.setdefault(estimate.method, {}).setdefault(stage, []).append(1e3 * seconds)
    rows = [
        [
            method,
            three_digits(float(np.median(times[""]))),
            ", ".join(f"{stage} {three_digits(float(np.median(ms)))}" for stage, ms in times.items() if stage),
        ]
        for method, times in stages.items()
    ]
    title = "Median time for a pair [ms]; the total leaves out read, wait and handover"
    groups = [RowGroup("", rows)]
    return (
        Table("times", title, ["total", "stages"], groups, None, text_columns=frozenset({"stages"})) if rows else None
    )


def _at(row: PoseBin) -> str:
    return (
        f"At {distance_text(row.low_m, row.high_m)} its RMS error is {millimetres(row.z_rmse_m)} mm in depth, "
        f"{millimetres(row.transverse_rmse_m)} mm across the line of sight, {three_digits(row.pitch_rmse_deg)} deg in "
        f"pitch and {three_digits(row.yaw_rmse_deg)} deg in yaw."
    )


def _against_bound(result: BenchmarkResult, name: str) -> list[str]:
    overall = result.methods[name].overall
    sentences = []
    ratios = [row.bound_ratio.z for row in result.methods[name].bins if row.bound_ratio is not None]
    if ratios:
        sentences.append(
            f"Bin by bin, its depth error is {_span(ratios)} times the Cramér–Rao bound, the smallest error that "
            "centroids of the measured noise allow."
        )
    if overall.centroid_share is not None:
        sentences.append(
            f"The errors of its own centroids explain {percent(round(overall.centroid_share, 3))} of its mean squared "
            "position error; the rest is the method's own."
        )
    return sentences


def _others(result: BenchmarkResult, best: str) -> list[str]:
    others = {
        name: method.overall.position_mean_m
        for name, method in result.methods.items()
        if name != best and method.overall.position_mean_m is not None
    }
    silent = [name for name, method in result.methods.items() if not method.overall.fixes]
    sentences = []
    if others:
        ranked = sorted(others, key=lambda name: others[name])
        listed = ", ".join(
            f"{name} {millimetres(others[name])} mm ({percent(result.methods[name].overall.fix_fraction)} of pairs)"
            for name in ranked
        )
        sentences.append(f"Mean position errors of the other methods: {listed}.")
    if silent:
        sentences.append(f"No pose at all came from {', '.join(silent)}.")
    return sentences


def _span(values: list[float]) -> str:
    low, high = three_digits(min(values)), three_digits(max(values))
    return low if low == high else f"{low} to {high}"
