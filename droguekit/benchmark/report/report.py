"""The benchmark as one HTML page that needs nothing from outside: no network, no script, no other file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import read_estimates
from drogue_models.marker_layout import marker_layout
from droguekit.benchmark.report.check_tables import check_tables
from droguekit.benchmark.report.figures import FEW_METHODS, QUANTITIES, error_panel, legend_key, method_styles
from droguekit.benchmark.report.label_thumbnails import contact_tiles
from droguekit.benchmark.report.narrative import result_sentences
from droguekit.benchmark.report.number_text import plain_number, three_digits
from droguekit.benchmark.report.report_tables import (
    centroid_table,
    component_tables,
    overall_table,
    position_table,
    rangefinder_tables,
)
from droguekit.benchmark.report.sequence_report import sequence_section
from droguekit.benchmark.results.benchmark_result import BenchmarkResult
from droguekit.benchmark.sequences.sequence_latency import worked_s


def write_report(dataset: Location, estimates: Path, result: BenchmarkResult, out_html: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        dataset: the dataset's folder, for its facts and pictures.
        estimates: the file that was scored, for the times that its methods took.
        result: what `run_benchmark` made of the two.
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
    page = page_template("report.html.j2").render(
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
        ],
        has_readings=any(method.overall.rangefinder is not None for method in result.methods.values()),
        times=stage_times_ms(estimates),
        sequences=None if result.sequences is None else sequence_section(result.sequences, styles),
    )
    write_text_atomic(out_html, page)


def page_template(name: str) -> Template:
    """A template of this package; what it is not given is an error."""
    environment = Environment(
        loader=PackageLoader("droguekit.benchmark"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def dataset_facts(manifest: Manifest, estimates_name: str) -> list[tuple[str, str]]:
    """What was measured on, as pairs of a name and a value."""
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


def stage_times_ms(estimates: Path) -> list[tuple[str, str, str]]:
    """Median time for a pair by method: name, total without waiting, and the stages. [ms]

    Pairs on which no time was worked, and methods that report none, are left out.
    """
    stages: dict[str, dict[str, list[float]]] = {}
    for estimate in read_estimates(estimates):
        work_s = worked_s(estimate.stage_s)
        if work_s is None:
            continue
        for stage, seconds in {**estimate.stage_s, "": work_s}.items():
            stages.setdefault(estimate.method, {}).setdefault(stage, []).append(1e3 * seconds)
    return [
        (
            method,
            three_digits(float(np.median(times[""]))),
            ", ".join(f"{stage} {three_digits(float(np.median(ms)))}" for stage, ms in times.items() if stage),
        )
        for method, times in stages.items()
    ]
