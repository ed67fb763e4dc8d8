"""`droguekit validate`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from droguekit.cli.arguments import DatasetArgument
from droguekit.cli.main import FAULT

if TYPE_CHECKING:
    from datasets_manifest.release.publication import PublishedComparison

EXAMPLES = (
    "droguekit validate data/demo",
    "droguekit validate data/demo --published   (compare with the published demo)",
)


def validate(
    dataset: DatasetArgument,
    published: Annotated[
        bool, typer.Option("--published", help="Also compare with the published manifest of the dataset's recipe.")
    ] = False,
) -> None:
    """Check that all files are there and unchanged, that labels agree with part ids, and annotations with records.

    With --published, also check whether it is the published dataset: bit for bit, or with the same labels where it was
    made with other packages or on another processor.

    Exits with 1 and prints a line for each fault it finds, up to 100 of a kind.
    """
    from labelgen.validation.dataset_checks import validate_dataset

    report = validate_dataset(dataset)
    typer.echo(report.table())
    for line in report.fault_lines():
        typer.echo(line)
    typer.echo(f"{dataset}: {report.pairs} pairs, {len(report.faults) or 'no'} faults")
    if not report.passed:
        raise typer.Exit(FAULT)
    if published:
        from datasets_manifest.release.publication import compare_with_published, read_publication
        from datasets_manifest.storage.manifest import read_manifest

        comparison = compare_with_published(dataset, read_publication(read_manifest(dataset).name))
        _show(comparison)
        if comparison.verdict == "different":
            raise typer.Exit(FAULT)


def _show(comparison: PublishedComparison) -> None:
    for difference in comparison.build_differences:
        typer.echo(f"not the build that was published: {difference}")
    for fault in comparison.label_faults:
        typer.echo(fault)
    pairs, same = comparison.compared, comparison.identical
    if comparison.verdict == "identical":
        typer.echo(f"published: all {pairs} pairs compared are the same bit for bit, records and images")
    elif comparison.verdict == "equivalent":
        typer.echo(
            f"published: the labels of all {pairs} pairs compared agree within 1e-9; records and images are the same "
            f"bit for bit in {same} of them, and need not be with another build"
        )
    elif comparison.label_faults:
        typer.echo("published: this is not the dataset that was published")
    else:
        typer.echo(
            f"published: labels agree, but {pairs - same} of {pairs} pairs have other pixels although packages and "
            "processor are those of the published dataset"
        )
