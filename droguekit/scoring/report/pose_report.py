"""The benchmark as one HTML page that needs nothing from outside: no network, no script, no other file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import read_estimates
from drogue_models.marker_layout import marker_layout
from droguekit.scoring.poses.method_scores import best_method
from droguekit.scoring.report.figures import FEW_METHODS, QUANTITIES, error_panel, legend_key, method_styles
from droguekit.scoring.report.html_page import RowGroup, Table, page_template
from droguekit.scoring.report.label_drawing import contact_tiles
from droguekit.scoring.report.number_text import (
    distance_text,
    interval_text,
    millimetres,
    percent,
    plain_number,
    three_digits,
)
from droguekit.scoring.report.pose_tables import (
    centroid_table,
    check_tables,
    component_tables,
    overall_table,
    position_table,
    rangefinder_tables,
)
from droguekit.scoring.report.sequence_report import sequence_section
from droguekit.scoring.results.benchmark_result import BenchmarkResult, PoseBin
from droguekit.scoring.sequences.sequence_latency import processing_time_s


def write_report(dataset: Location, estimates: Path, result: BenchmarkResult, out_html: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        dataset: the dataset's folder, for its facts and pictures.
        estimates: the file that was scored, for the times that its methods took.
        result: of `run_benchmark` for both.
        out_html: where to write.

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
    page = page_template("pose_report.html.j2").render(
        result=result,
        sentences=result_sentences(result),
        facts=dataset_facts(data.manifest, estimates.name),
        tiles=[(tile, plain_number(tile.distance_m)) for tile in contact_tiles(data)],
        panels=[Markup(error_panel(result, quantity)) for quantity in QUANTITIES],
        legend=[(name, Markup(legend_key(style))) for name, style in styles.items()],
        many_methods=len(styles) > FEW_METHODS,
        bound_key=Markup(legend_key(None)),
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
    ends = interval_text(method.overall.intervals["position_mean_m"], 1e3)
    sentences = [
        f"Over {shown} stereo pairs from {low} to {high} m, {best} came closest to the truth: its mean position error "
        f"is {millimetres(method.overall.position_mean_m)} mm (95 % interval {ends} mm), and it found a pose in "
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
