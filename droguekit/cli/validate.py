"""`droguekit validate`."""

from __future__ import annotations

import typer

from droguekit.cli.arguments import DatasetArgument
from droguekit.cli.main import FAULT

EXAMPLES = ("droguekit validate data/demo",)


def validate(dataset: DatasetArgument) -> None:
    """Check a dataset: every file there and unchanged, labels in agreement with part ids, annotations with records.

    Exits with 1 and a line for each fault when something is wrong.
    """
    from labelgen.dataset_validation import validate_dataset

    report = validate_dataset(dataset)
    typer.echo(report.table())
    for fault in report.faults:
        typer.echo(fault)
    typer.echo(f"{dataset}: {report.pairs} pairs, {len(report.faults) or 'no'} faults")
    if not report.passed:
        raise typer.Exit(FAULT)
