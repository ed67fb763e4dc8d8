"""`droguekit report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datasets_manifest.storage.storage import as_location
from droguekit.cli.arguments import Place, exit_with_fault
from droguekit.cli.outputs import output_option

if TYPE_CHECKING:
    from studies.paper.paper_report import DatasetWithEstimates, ReportInputs

EXAMPLES = {
    "report": (
        "droguekit report --docking data/docking:docking.jsonl --html report.html",
        "droguekit report --semi-physical data/bench-5:bench-5.jsonl --semi-physical data/bench-7:bench-7.jsonl \\",
        "                 --detection detection.json --corpus data/corpus --html report.html --pdf report.pdf",
    ),
}


def report(
    docking: Annotated[
        list[str] | None,
        typer.Option(
            "--docking",
            metavar="DIR:FILE.jsonl",
            help="Dataset of docking runs (docking-10m) and its estimates: Figures 16 to 18. Repeatable.",
        ),
    ] = None,
    docking_sequence: Annotated[
        int | None,
        typer.Option("--docking-sequence", metavar="N", help="Run in Figures 16 to 18; by default the first."),
    ] = None,
    semi_physical: Annotated[
        list[str] | None,
        typer.Option(
            "--semi-physical",
            metavar="DIR:FILE.jsonl",
            help="Dataset of the bench (semi-physical-5, -7) and its estimates: Table 2, Figure 19. Repeatable.",
        ),
    ] = None,
    detection: Annotated[
        Path | None,
        typer.Option(
            "--detection", metavar="FILE.json", help="Of `benchmark --detector`, its --json: Table 1, Figure 11."
        ),
    ] = None,
    corpus: Annotated[
        Place | None,
        typer.Option("--corpus", metavar="DIR", parser=str, help="The detectors' dataset: Figure 10."),
    ] = None,
    html: Annotated[Path | None, output_option("--html", "FILE", "Gets the page, one file.")] = None,
    pdf: Annotated[Path | None, output_option("--pdf", "FILE", "Gets it for print; needs Chromium or Chrome.")] = None,
) -> None:
    """Put our numbers beside the seed paper's: its tables and figures, as one page and as a PDF.

    Every input is optional. What is not given is left out, with a line that says which command makes it. Exits with 1
    where a record is damaged, and leaves its pair out.
    """
    from studies.paper.paper_report import ReportInputs

    if html is None and pdf is None:
        raise ValueError("--html, --pdf: give at least one; there is nowhere to write to")
    if not docking and docking_sequence is not None:
        raise ValueError("--docking-sequence: needs --docking")
    inputs = ReportInputs(
        docking=tuple(_pair("--docking", text) for text in docking or ()),
        docking_sequence=docking_sequence,
        semi_physical=tuple(_pair("--semi-physical", text) for text in semi_physical or ()),
        detection=detection,
        corpus=None if corpus is None else as_location(str(corpus)),
    )
    _check_outputs(inputs, html, pdf)
    exit_with_fault(_write(inputs, html, pdf))


def _check_outputs(inputs: ReportInputs, html: Path | None, pdf: Path | None) -> None:
    """Nothing that is read or just written may be replaced.

    Raises:
        ValueError: an output is an input or lies in a dataset.
    """
    navigated = [*inputs.docking, *inputs.semi_physical]
    files = [pair.estimates for pair in navigated] + ([] if inputs.detection is None else [inputs.detection])
    places = [pair.dataset for pair in navigated] + ([] if inputs.corpus is None else [inputs.corpus])
    read = {path.resolve() for path in files}
    folders = {place.resolve() for place in places if isinstance(place, Path)}
    for option, out in (("--html", html), ("--pdf", pdf)):
        if out is None:
            continue
        whole = out.resolve()
        if whole in read:
            raise ValueError(f"{option}: {out} is an input and would be replaced; choose another name")
        if not folders.isdisjoint([whole, *whole.parents]):
            raise ValueError(f"{option}: {out} lies in a dataset that is read; choose another folder")


def _write(inputs: ReportInputs, html: Path | None, pdf: Path | None) -> str | None:
    """Write the page first, so that it is there when no browser can print it; the fault of damaged pairs, or None."""
    from datasets_manifest.atomic import write_text_atomic
    from datasets_manifest.storage.pair_faults import PairFaults
    from droguekit.visualization.print_pdf import print_pdf
    from studies.paper.paper_report import build_page

    faults = PairFaults()
    text = build_page(inputs, faults)
    if html is not None:
        write_text_atomic(html, text)
        typer.echo(f"wrote {html}")
    if pdf is not None:
        print_pdf(text, pdf)
        typer.echo(f"wrote {pdf}")
    return faults.line()


def _pair(option: str, text: str) -> DatasetWithEstimates:
    """A dataset and its estimates, divided at the last colon, for a URL has one too.

    Raises:
        ValueError: not of that form.
    """
    from studies.paper.paper_report import DatasetWithEstimates

    dataset, colon, estimates = text.rpartition(":")
    if not colon or not dataset or not estimates or estimates.startswith("//"):
        raise ValueError(f"{option}: must be DIR:FILE.jsonl, a dataset and its estimates, got {text!r}")
    return DatasetWithEstimates(as_location(dataset), Path(estimates))
