"""The report as one HTML page that needs nothing from outside: no network, no script, no other file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template
from pydantic import ValidationError

from datasets_manifest.storage.storage import Location
from droguekit.benchmark.results.detection_result import DetectionResult
from studies.paper.claims import Claim, detection_claims, docking_claims, semi_physical_claims
from studies.paper.contenders import NAVIGATE_OPTIONS
from studies.paper.corpus_figures import read_corpus
from studies.paper.docking_run import DockingData, read_docking
from studies.paper.page_tables import detection_source, docking_table, table_1, table_2
from studies.paper.provenance import code_facts, dataset_facts, file_sha256
from studies.paper.published import CONTRADICTION, TITLE
from studies.paper.sections import (
    absent_sentence,
    bench_figures,
    corpus_figures,
    docking_figures,
    failures,
    speed_figures,
    time_rows,
    worst_part,
)
from studies.paper.semi_physical import SemiPhysicalRun, read_semi_physical
from studies.paper.worst_frames import BOX_COLOR, CENTROID_COLOR, ESTIMATED_COLOR, TRUE_COLOR


class Navigated(NamedTuple):
    """A dataset with the estimates that were made on it."""

    dataset: Location
    estimates: Path


@dataclass(frozen=True)
class ReportInputs:
    """What the page is made from; a part whose input is missing is left out with a line that says how to make it.

    Attributes:
        docking: docking runs.
        docking_sequence: which run of each the figures show, the first one when None.
        semi_physical: bench experiments.
        detection: the JSON file of `droguekit benchmark` on detections.
        corpus: the detectors' dataset.
    """

    docking: tuple[Navigated, ...] = ()
    docking_sequence: int | None = None
    semi_physical: tuple[Navigated, ...] = ()
    detection: Path | None = None
    corpus: Location | None = None


class LeftOut(NamedTuple):
    """A part that is not on the page, and the commands that make its input."""

    what: str
    commands: tuple[str, ...]
    option: str


def build_page(inputs: ReportInputs) -> str:
    """The whole page.

    Raises:
        ValueError: no input at all, or one that cannot be read or does not fit the others.
    """
    docking = [read_docking(*navigated) for navigated in inputs.docking]
    bench = [read_semi_physical(*navigated) for navigated in inputs.semi_physical]
    detection = None if inputs.detection is None else read_detection(inputs.detection)
    corpus = None if inputs.corpus is None else read_corpus(inputs.corpus)
    if not (docking or bench or detection or corpus):
        raise ValueError("report: nothing to report on; give --docking, --semi-physical, --detection or --corpus")
    facts = code_facts()
    for data in (*docking, *bench):
        facts += [*dataset_facts(data.manifest), (f"Estimates {data.file.path.name}", data.file.sha256)]
    if detection is not None and inputs.detection is not None:
        facts += _detection_facts(detection, inputs.detection)
    if corpus is not None:
        facts += dataset_facts(corpus.manifest)
    return _template().render(
        paper=TITLE,
        contradiction=CONTRADICTION,
        claims=_claims(docking, bench, detection),
        left_out=left_out(inputs),
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


def left_out(inputs: ReportInputs) -> list[LeftOut]:
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
        (inputs.corpus, LeftOut("Figure 10", ("droguekit render paper-corpus --out corpus",), "--corpus corpus")),
        (inputs.detection, LeftOut("Table 1 and Figure 11", scores, "--detection detection.json")),
        (
            inputs.docking,
            LeftOut("Figures 16 to 18, worst frames and times", docking, "--docking docking:docking.jsonl"),
        ),
        (inputs.semi_physical, LeftOut("Table 2 and Figure 19", bench, "--semi-physical bench-7:bench-7.jsonl")),
    ]
    return [part for given, part in parts if not given]


def _docking_part(docking: DockingData, sequence: int | None, number: int) -> dict[str, Any]:
    run = docking.run(docking.sequences()[0] if sequence is None else sequence)
    return {
        "source": docking.source,
        "figures": docking_figures(docking, run, number),
        "table": docking_table(docking, f"docking-errors-{number}"),
        "has_filtered": any(contender.is_filtered for contender in docking.contenders),
        "note": absent_sentence(list(docking.methods), docking.file.path),
        "worst": worst_part(docking, number),
        "failures": failures(docking),
        "times": time_rows(docking),
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


def _template() -> Template:
    # The style sheet is that of the benchmark's report.
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("studies.paper"), PackageLoader("droguekit.benchmark")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("paper_report.html.j2")
