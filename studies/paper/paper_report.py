"""The report as one HTML page that needs nothing from outside: no network, no script, no other file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from pydantic import ValidationError

from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.storage import Location
from droguekit.scoring.detection.detection_figures import is_timed, speed_panel
from droguekit.scoring.report.figures import MethodStyle, legend_key, method_styles
from droguekit.scoring.report.html_page import RowGroup, Table, page_template
from droguekit.scoring.report.number_text import ABSENT, plain_number, three_digits
from droguekit.scoring.results.detection_result import DetectionResult
from droguekit.scoring.sequences.sequence_latency import processing_time_s
from studies.paper.docking_experiment import (
    BOX_COLOR,
    CENTROID_COLOR,
    ESTIMATED_COLOR,
    TRUE_COLOR,
    DockingData,
    DockingRun,
    failure_reasons,
    read_docking,
    worst_frames,
)
from studies.paper.paper_figures import (
    AXES,
    PITCH,
    YAW,
    CorpusBoxes,
    X,
    Y,
    Z,
    error_series,
    length_series,
    measured_panel,
    place_panel,
    read_corpus,
    shape_panel,
    size_panel,
    station_panel,
    truth_series,
)
from studies.paper.paper_inputs import code_facts, dataset_facts, file_sha256
from studies.paper.paper_tables import (
    Claim,
    detection_claims,
    detection_source,
    docking_claims,
    docking_table,
    semi_physical_claims,
    table_1,
    table_2,
)
from studies.paper.published_results import (
    CONTRADICTION,
    CORPUS_SENTENCE,
    FILTERED,
    NAVIGATE_OPTIONS,
    OURS,
    PAPER,
    TITLE,
    Contender,
    absent,
    style_of,
)
from studies.paper.semi_physical import SemiPhysicalRun, read_semi_physical

_PERCENTILES = (50, 90, 99)


class DatasetWithEstimates(NamedTuple):
    """A dataset with the estimates that were made on it."""

    dataset: Location
    estimates: Path


@dataclass(frozen=True)
class ReportInputs:
    """Inputs of the page. A part whose input is missing is left out, with a line that says how to make it.

    Attributes:
        docking: docking runs.
        docking_sequence: which run of each the figures show, the first one when None.
        semi_physical: bench experiments.
        detection: the JSON file of `droguekit benchmark` on detections.
        corpus: the detectors' dataset.
    """

    docking: tuple[DatasetWithEstimates, ...] = ()
    docking_sequence: int | None = None
    semi_physical: tuple[DatasetWithEstimates, ...] = ()
    detection: Path | None = None
    corpus: Location | None = None


class MissingPart(NamedTuple):
    """A part that is missing on the page, and the commands that make its input."""

    what: str
    commands: tuple[str, ...]
    option: str


@dataclass(frozen=True)
class FigureGroup:
    """Panels under one caption.

    Attributes:
        anchor: id on the page.
        title: with the paper's number.
        caption: below the title.
        panels: `<svg>` elements.
        legend: names with their lines; empty where there is only one.
    """

    anchor: str
    title: str
    caption: str
    panels: list[Markup]
    legend: list[tuple[str, Markup]] = field(default_factory=list)


def build_page(inputs: ReportInputs, faults: PairFaults | None = None) -> str:
    """The whole page; damaged pairs are left out where `faults` counts them.

    Raises:
        ValueError: no input at all, or one that cannot be read or does not fit the others.
    """
    docking = [read_docking(*navigated, faults) for navigated in inputs.docking]
    bench = [read_semi_physical(*navigated, faults) for navigated in inputs.semi_physical]
    detection = None if inputs.detection is None else read_detection(inputs.detection)
    corpus = None if inputs.corpus is None else read_corpus(inputs.corpus, faults)
    if not (docking or bench or detection or corpus):
        raise ValueError("report: nothing to report on; give --docking, --semi-physical, --detection or --corpus")
    facts = code_facts()
    for data in (*docking, *bench):
        facts += [*dataset_facts(data.manifest), (f"Estimates {data.file.path.name}", data.file.sha256)]
    if detection is not None and inputs.detection is not None:
        facts += _detection_facts(detection, inputs.detection)
    if corpus is not None:
        facts += dataset_facts(corpus.manifest)
    return page_template("paper_report.html.j2", "studies.paper").render(
        paper=TITLE,
        contradiction=CONTRADICTION,
        claims=_claims(docking, bench, detection),
        missing_parts=missing_parts(inputs),
        detection=None if detection is None else table_1(detection),
        detection_figures=[
            *([] if corpus is None else corpus_figures(corpus)),
            *([] if detection is None else speed_figures(detection)),
        ],
        docking=[_docking_part(data, inputs.docking_sequence, k) for k, data in enumerate(docking, start=1)],
        bench=table_2(bench) if bench else None,
        bench_figures=[bench_figures(run, number) for number, run in enumerate(bench, start=1)],
        bench_notes=[note for run in bench if (note := absent_sentence(list(run.methods), run.file.path))],
        colors={"true": TRUE_COLOR, "estimated": ESTIMATED_COLOR, "centroid": CENTROID_COLOR, "box": BOX_COLOR},
        facts=facts,
    )


def read_detection(path: Path) -> DetectionResult:
    """A file of detection scores.

    Raises:
        ValueError: it cannot be read, or is none.
    """
    try:
        result = DetectionResult.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValidationError as error:
        raise ValueError(
            f"{path}: holds no detection scores; they come from droguekit benchmark DIR --detector NETWORK --json FILE"
        ) from error
    if not result.detectors:
        raise ValueError(f"{path}: detectors: must not be empty")
    return result


def missing_parts(inputs: ReportInputs) -> list[MissingPart]:
    """The parts whose inputs are missing."""
    docking = (
        "droguekit render docking-10m --out docking",
        f"droguekit navigate docking {NAVIGATE_OPTIONS} --out docking.jsonl",
    )
    bench = (
        "droguekit render semi-physical-7 --out bench-7",
        f"droguekit navigate bench-7 {NAVIGATE_OPTIONS} --out bench-7.jsonl",
    )
    scores = ("droguekit benchmark CORPUS --detector NETWORK.onnx --json detection.json",)
    parts = [
        (inputs.corpus, MissingPart("Figure 10", ("droguekit render paper-corpus --out corpus",), "--corpus corpus")),
        (inputs.detection, MissingPart("Table 1 and Figure 11", scores, "--detection detection.json")),
        (
            inputs.docking,
            MissingPart("Figures 16 to 18, worst frames and times", docking, "--docking docking:docking.jsonl"),
        ),
        (inputs.semi_physical, MissingPart("Table 2 and Figure 19", bench, "--semi-physical bench-7:bench-7.jsonl")),
    ]
    return [part for given, part in parts if not given]


def corpus_figures(corpus: CorpusBoxes) -> list[FigureGroup]:
    """The paper's Figure 10."""
    low, high = (plain_number(float(end)) for end in (corpus.distances_m.min(), corpus.distances_m.max()))
    caption = (
        f"{len(corpus.boxes)} drogues in {corpus.images} images of {corpus.scenes} scenes of {corpus.source}, from "
        f"{low} to {high} m; the visible box, both eyes. The stronger a cell's colour, the more drogues. "
        f"{CORPUS_SENTENCE}"
    )
    panels = [Markup(panel(corpus)) for panel in (place_panel, shape_panel, size_panel)]
    return [FigureGroup("figure-10", "Figure 10. Size and location of the drogue in the dataset", caption, panels)]


def speed_figures(result: DetectionResult) -> list[FigureGroup]:
    """The paper's Figure 11; none where no detector was timed."""
    if not is_timed(result):
        return []
    styles = method_styles(list(result.detectors))
    legend = [(name, _key(f"figure-11-{k}", style)) for k, (name, style) in enumerate(styles.items())]
    caption = (
        f"Filled: measured here on {detection_source(result)}; a detector's median time of a pair, halved, on the "
        "machine that made the scores (not named in the file). Hollow: published, on other data and another machine "
        "(Nvidia Xavier AGX)."
    )
    return [
        FigureGroup("figure-11", "Figure 11. Accuracy against speed", caption, [Markup(speed_panel(result))], legend)
    ]


def docking_figures(docking: DockingData, run: DockingRun, number: int) -> list[FigureGroup]:
    """The paper's Figures 16 to 18; `number` keeps several datasets apart."""
    chosen = docking.contenders
    own = [contender for contender in chosen if contender.method in (OURS, FILTERED)]
    rivals = [contender for contender in chosen if contender.method != FILTERED]
    of = f"Sequence {run.sequence_id}" if run.sequence_id is not None else "All pairs"
    span = f"{of} of {docking.source}: {len(run.numbers)} pairs, Z from {_ends(run)} m"
    names = [f"figure-{figure}-{number}" for figure in (16, 17, 18)]
    groups = []
    if own:
        panels = [Markup(error_series(names[0], run, own, quantity)) for quantity in (X, Y, Z, YAW, PITCH)]
        caption = (
            f"{span}. Estimate minus truth in the left camera. The paper shows these of its own method and says that "
            "they stay within ±100 mm and ±0.5°; those limits are dotted where they fit into a panel."
        )
        groups.append(
            FigureGroup(
                names[0], "Figure 16. Errors of our method while docking", caption, panels, _legend(names[0], own)
            )
        )
    if rivals:
        truth = [Markup(truth_series(names[1], run, rivals, quantity)) for quantity in (X, Y, Z)]
        errors = [Markup(error_series(names[2], run, rivals, quantity)) for quantity in (X, Y, Z)]
        groups += [
            FigureGroup(
                names[1],
                "Figure 17. Estimates and truth of X, Y, Z",
                f"{span}. The wide pale line is the truth. Where errors are small against the panel, the lines lie on "
                "each other and the first of the legend covers the others; Figure 18 tells them apart. Panels reach "
                "as far as the truth does; poses beyond are counted above them.",
                truth,
                _legend(names[1], rivals),
            ),
            FigureGroup(
                names[2],
                "Figure 18. Errors of the algorithms in X, Y, Z",
                f"{span}. Where a few errors are far larger, a panel shows 99 % of each method's; the last one "
                "shows all.",
                [*errors, Markup(length_series(names[2], run, rivals))],
                _legend(names[2], rivals),
            ),
        ]
    return groups


def bench_figures(run: SemiPhysicalRun, number: int) -> FigureGroup:
    """The paper's Figure 19; `number` keeps several experiments apart."""
    anchor = f"figure-19-{number}"
    panels = [Markup(measured_panel(run, anchor)), *(Markup(station_panel(run, anchor, axis)) for axis in AXES)]
    most = max(errors.pairs for errors in run.methods.values())
    caption = (
        f"{run.source}, {most} pairs: mean size of the errors at each station, logarithmic. Z is compared with "
        "the rangefinder's reading, as in the paper's experiment, X and Y with the truth. The wide pale line is "
        "equality; dotted is what the paper prints of its own method with as many markers, on other data."
    )
    title = f"Figure 19. Errors against distance, {run.markers} markers"
    return FigureGroup(anchor, title, caption, panels, _legend(anchor, run.contenders))


def worst_part(docking: DockingData, number: int) -> dict[str, object]:
    """Pictures of the worst frames, of our method where the file has it; `number` keeps several datasets apart."""
    names = [contender.method for contender in docking.contenders]
    method = next(name for name in (OURS, FILTERED, PAPER, *names) if name in names)
    frames = [(frame, Markup(frame.svg)) for frame in worst_frames(docking, method)]
    return {"anchor": f"worst-{number}", "method": method, "frames": frames}


def failure_table(docking: DockingData, anchor: str) -> Table | None:
    """For each reason in how many pairs each method gave no pose for it; None if all gave one in every pair."""
    methods = [contender.method for contender in docking.contenders]
    counts = [Counter(dict(failure_reasons(docking, method))) for method in methods]
    total = sum(counts, Counter[str]())
    if not total:
        return None
    rows = [[reason, *(str(of[reason]) for of in counts)] for reason, _ in total.most_common()]
    title = f"Pairs with a drogue and without a pose: {docking.source}"
    return Table(anchor, title, methods, [RowGroup("", rows)], first=None, second="reason")


def time_table(docking: DockingData, anchor: str) -> Table | None:
    """Median time by method, without waiting and by stage, and percentiles of the latency where reported. [ms]

    A stage that only some timed pairs had is followed by their share. None where no method reports times.
    """
    rows = []
    for contender in docking.contenders:
        estimates = docking.methods[contender.method].values()
        latencies = [1e3 * estimate.latency_s for estimate in estimates if estimate.latency_s is not None]
        latency = [three_digits(float(value)) for value in np.percentile(latencies, _PERCENTILES)] if latencies else []
        stages: dict[str, list[float]] = {}
        for estimate in estimates:
            for stage, seconds in estimate.stage_s.items():
                stages.setdefault(stage, []).append(1e3 * seconds)
        work = [processing_time_s(estimate.stage_s) for estimate in estimates]
        totals = [1e3 * work_s for work_s in work if work_s is not None]
        if totals or latency:
            timed = sum(bool(estimate.stage_s) for estimate in estimates)
            listed = ", ".join(
                f"{stage} {_median(times)}{_share(len(times), timed)}" for stage, times in stages.items()
            )
            rows.append([contender.method, _median(totals), " / ".join(latency) or ABSENT, listed or ABSENT])
    title = (
        "Median by stage (and in how many of the pairs, if not all), and latency where it was measured, on the machine "
        "that made the estimates (not named in the file) [ms]"
    )
    columns, words = ["total", "latency, 50 / 90 / 99 %", "stages"], frozenset({"stages"})
    return Table(anchor, title, columns, [RowGroup("", rows)], None, text_columns=words) if rows else None


def _share(pairs: int, of_pairs: int) -> str:
    return "" if pairs == of_pairs else f" ({pairs / of_pairs:.0%})"


def _median(values: Sequence[float]) -> str:
    return three_digits(float(np.median(values))) if values else ABSENT


def absent_sentence(methods: Sequence[str], where: Path) -> str | None:
    """Which contenders a file lacks; None if none."""
    names = [contender.method for contender in absent(methods)]
    if not names:
        return None
    options = " ".join(f"--method {name}" for name in names)
    return f"{where.name} has no estimates of {', '.join(names)}: navigate with {options} besides."


def _legend(figure_name: str, contenders: Sequence[Contender]) -> list[tuple[str, Markup]]:
    return [
        (contender.label, _key(f"{figure_name}-{contender.method}", style_of(contender.method)))
        for contender in contenders
    ]


def _key(name: str, style: MethodStyle) -> Markup:
    """A line of a legend; `name` makes its ids unique on the page."""
    plain = re.sub(r"\W", "-", name)
    return Markup(re.sub(r"([\"#])key-", rf"\g<1>{plain}-key-", legend_key(style)))


def _ends(run: DockingRun) -> str:
    return " to ".join(plain_number(float(z)) for z in (run.truth[0, 2], run.truth[-1, 2]))


def _docking_part(docking: DockingData, sequence: int | None, number: int) -> dict[str, Any]:
    run = docking.run(docking.sequences()[0] if sequence is None else sequence)
    return {
        "source": docking.source,
        "figures": docking_figures(docking, run, number),
        "table": docking_table(docking, f"docking-errors-{number}"),
        "has_filtered": any(contender.is_filtered for contender in docking.contenders),
        "note": absent_sentence(list(docking.methods), docking.file.path),
        "worst": worst_part(docking, number),
        "failures": failure_table(docking, f"failures-{number}"),
        "times": time_table(docking, f"times-{number}"),
        "number": number,
    }


def _claims(docking: list[DockingData], bench: list[SemiPhysicalRun], detection: DetectionResult | None) -> list[Claim]:
    return [
        *(claim for data in docking for claim in docking_claims(data)),
        *semi_physical_claims(bench),
        *([] if detection is None else detection_claims(detection)),
    ]


def _detection_facts(detection: DetectionResult, path: Path) -> list[tuple[str, str]]:
    return [
        (f"Dataset of {detection_source(detection)}", detection.dataset.sha256 or "none, imported"),
        (f"Detection scores, {path.name}", file_sha256(path)),
        ("Code that made the detection scores", f"droguekit {detection.code_version}"),
    ]
