"""Commands that make and check datasets: new, plan, check, render, merge, validate, reproduce."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import human_size, progress_report
from droguekit.cli.arguments import (
    DatasetArgument,
    DeviceOption,
    EngineOption,
    Place,
    PositiveWorkersOption,
    RecipeArgument,
    SeedOption,
    TarOption,
    WorkersOption,
    named_place,
    parse_frames,
    parse_shard,
    places,
)
from droguekit.cli.main import FAULT
from droguekit.cli.outputs import output_option

if TYPE_CHECKING:
    from datasets_manifest.release.publication import PublishedComparison

EXAMPLES = {
    "new": (
        "droguekit new drogue --out basket.toml --markers 12 --marker-radius 0.01 --luminance 20000",
        "droguekit new rig --out acme-rig.toml --size 1920x1200 --focal-px 1739 --baseline 0.25 --bits 12",
        "droguekit new rig --out acme-rig.toml --calibration stereo.yaml   (your own cameras, as calibrated)",
        "droguekit new recipe --out acme.toml --drogue basket.toml --rig acme-rig.toml --distance 5:60",
    ),
    "plan": (
        "droguekit plan demo",
        "droguekit plan paper-corpus --html plan.html   (with plots of distances, sizes and places)",
        "droguekit plan my-recipe.toml --no-probe   (without rendering: no time and size)",
        "droguekit plan world-real --probe 20   (a better estimate, for more time)",
    ),
    "check": (
        "droguekit check demo",
        "droguekit check my-recipe.toml --html check.html --json check.json",
        "droguekit check my-recipe.toml --engine analytic --html check.html   (pictures without a path tracer)",
    ),
    "render": (
        "droguekit render demo --out data/demo",
        "droguekit render my-recipe.toml --out data/mine --seed 7 --workers 4",
        "droguekit render demo --out data/demo --frames 0:10   (a part now, the rest later)",
        "droguekit render my-recipe.toml --out s3://bucket/mine --tar 1000   (object store, tar files of 1000 pairs)",
        "droguekit render demo --out data/demo-0 --shard 0/4   (a quarter, the rest elsewhere; see `merge`)",
    ),
    "merge": ("droguekit merge data/demo data/demo-0 data/demo-1",),
    "validate": (
        "droguekit validate data/demo",
        "droguekit validate data/demo --published   (compare with the published demo)",
    ),
    "reproduce": ("droguekit reproduce data/demo --frame 12",),
}


# The options of `new` that only one kind has.
_OF_KIND = {
    "drogue": ("rim_radius", "markers", "marker_radius", "luminance"),
    "rig": ("preset", "size", "focal_px", "baseline", "calibration", "calibration_unit", "bits"),
    "recipe": ("drogue", "rig", "distance", "pairs"),
}


def new(
    context: typer.Context,
    kind: Annotated[Literal["drogue", "rig", "recipe"], typer.Argument(help="What to write.")],
    out: Annotated[Path, output_option("--out", "FILE.toml", "File to write; must not exist yet.")],
    rim_radius: Annotated[float, typer.Option("--rim-radius", metavar="M", help="Drogue: outermost radius.")] = 0.305,
    markers: Annotated[int, typer.Option("--markers", help="Drogue: number of markers in an even ring.")] = 8,
    marker_radius: Annotated[float, typer.Option("--marker-radius", metavar="M", help="Drogue: of a marker.")] = 0.01,
    luminance: Annotated[
        float, typer.Option("--luminance", metavar="CD/M2", help="Drogue: of lit markers; 0 for paint.")
    ] = 0.0,
    preset: Annotated[str, typer.Option("--preset", help="Rig: the shipped one to start from.")] = "mono",
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="WIDTHxHEIGHT", help="Rig: of an image in pixels; 1280x960 by default."),
    ] = None,
    focal_px: Annotated[float, typer.Option("--focal-px", help="Rig: focal length over pixel pitch.")] = 2133.3,
    baseline: Annotated[float, typer.Option("--baseline", metavar="M", help="Rig: distance of the cameras.")] = 0.12,
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            "--calibration",
            metavar="FILE",
            help="Rig: stereo calibration of OpenCV, Kalibr, ROS, EuRoC or ORB-SLAM instead of focal length and "
            "baseline; given twice for two files. --size is then for files that lack it.",
        ),
    ] = None,
    calibration_unit: Annotated[str, typer.Option(metavar="m|cm|mm", help="Rig: of the calibration's baseline.")] = "m",
    bits: Annotated[int, typer.Option("--bits", help="Rig: of an image, 8 or 12.")] = 8,
    drogue: Annotated[str, typer.Option("--drogue", help="Recipe: a shipped drogue or a .toml file.")] = "red-8",
    rig: Annotated[str, typer.Option("--rig", help="Recipe: a shipped rig or a .toml file.")] = "mono",
    distance: Annotated[
        str, typer.Option("--distance", metavar="NEAR:FAR", help="Recipe: distances in metres.")
    ] = "5:40",
    pairs: Annotated[int, typer.Option("--pairs", help="Recipe: number of stereo pairs.")] = 100,
) -> None:
    """Write a commented drogue, rig or recipe with your numbers, to change and to use.

    The file is checked before it is written: numbers that do not fit together are told.
    """
    from droguekit.workflows.new_files import FileChoices, write_new_file

    for other, names in _OF_KIND.items():
        for name in names:
            source = context.get_parameter_source(name)
            if other != kind and source is not None and source.name != "DEFAULT":
                raise ValueError(f"--{name.replace('_', '-')}: is of a {other}, and this is a {kind}; leave it out")
    for name in ("focal_px", "baseline") if calibration else ("calibration_unit",):
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            reason = "the calibration has it; leave it out" if calibration else "is of --calibration, which is missing"
            raise ValueError(f"--{name.replace('_', '-')}: {reason}")
    choices = FileChoices(
        rim_radius_m=rim_radius,
        markers=markers,
        marker_radius_m=marker_radius,
        luminance_cd_m2=luminance,
        preset=preset,
        size=size,
        focal_px=focal_px,
        baseline_m=baseline,
        calibration=tuple(calibration or ()),
        calibration_unit=calibration_unit,
        bits=bits,
        drogue=drogue,
        rig=rig,
        distance=distance,
        pairs=pairs,
    )
    write_new_file(kind, out, choices)
    typer.echo(f"wrote {out}")


def plan(
    recipe: RecipeArgument,
    seed: SeedOption = None,
    probe: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Frames with a drogue to render for the estimate of time and size (3 to 5)."
        ),
    ] = None,
    no_probe: Annotated[bool, typer.Option("--no-probe", help="Render nothing: no time and size.")] = False,
    workers: PositiveWorkersOption = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
    html: Annotated[Path | None, output_option("--html", "FILE", "Write the plan with its plots as one page.")] = None,
) -> None:
    """Show what a recipe will make, how long it will take and how large it will get, without making it."""
    from droguekit.workflows.planning import plan_lines

    if no_probe and probe is not None:
        raise ValueError("--probe: renders frames, which --no-probe forbids; leave one out")
    probes = 0 if no_probe else probe
    for line in plan_lines(recipe, seed, engine, probes, ExecutionOptions(workers, device=device), html):
        typer.echo(line)


def check(
    recipe: RecipeArgument,
    seed: SeedOption = None,
    engine: EngineOption = None,
    json_: Annotated[Path | None, output_option("--json", "FILE", "Write the numbers.")] = None,
    html: Annotated[
        Path | None, output_option("--html", "FILE", "Write one page with plots and three rendered pictures.")
    ] = None,
) -> None:
    """Predict how well a recipe's markers can be measured, before anything is rendered at length.

    By day, at dusk and at night, and against distance: size, contrast and signal to noise of a marker, the error of its
    centre, the bound of the pose, and what will fail and what to change.
    """
    from droguekit.workflows.checking import checked_lines

    for line in checked_lines(recipe, seed, engine, json_, html):
        typer.echo(line)


def render(
    recipe: RecipeArgument,
    out: Annotated[
        Place,
        typer.Option(
            "--out",
            metavar="DIR",
            parser=str,
            callback=named_place,
            help="The dataset's folder, made if missing, or a URL such as s3://BUCKET/NAME.",
        ),
    ],
    seed: SeedOption = None,
    frames: Annotated[
        str | None, typer.Option("--frames", metavar="A:B", help="Only frames from A up to B - 1.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option("--shard", metavar="I/N", help="Only every N-th frame, starting with the I-th (counted from 0)."),
    ] = None,
    tar: TarOption = None,
    workers: WorkersOption = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            "--timeout", metavar="S", help="Seconds allowed for one frame; by default what `droguekit plan` shows."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Render on the workers of this Dask scheduler, such as tcp://HOST:8786.",
        ),
    ] = None,
    engine: EngineOption = None,
    device: DeviceOption = "cpu",
) -> None:
    """Make a dataset from a recipe.

    Run again, the same command continues where it stopped: it keeps complete pairs and renders damaged ones again, and
    the result is the same as that of an uninterrupted run. Ctrl-C finishes the pairs being rendered and stops; a second
    Ctrl-C stops at once.
    """
    from droguekit.workflows.rendering import open_recipe, render_frames, run_lines

    source = open_recipe(recipe, seed, engine)
    wanted = parse_shard(shard, parse_frames(frames, source.recipe.frames.count))
    options = ExecutionOptions(workers, timeout, scheduler, tar, device)
    summary = render_frames(source, out, wanted, options, progress_report())
    for line in run_lines(out, summary):
        typer.echo(line)
    for drop in summary.drops:
        typer.echo(f"frame {drop.frame_index} is missing: {drop.reason}", err=True)
    if summary.drops:
        raise typer.Exit(FAULT)


def merge(
    out: Annotated[
        Place,
        typer.Argument(
            metavar="OUT", parser=str, callback=named_place, help="The dataset's folder, made if missing, or a URL."
        ),
    ],
    shards: Annotated[
        list[Place],
        typer.Argument(
            metavar="SHARD...", parser=str, callback=places, help="Folders or URLs that `render --shard` made."
        ),
    ],
    tar: TarOption = None,
) -> None:
    """Join shards of one recipe into the dataset that a single run would have made.

    Refuses shards of different recipes, versions or processors, and shards with missing or damaged frames.
    """
    from droguekit.batch.merge_shards import merge_shards

    summary = merge_shards(out, shards, progress_report(), tar)
    size = human_size(summary.totals.size_bytes)
    typer.echo(f"{out}: joined {len(summary.totals.made)} pairs ({size}), kept {summary.kept}")
    typer.echo(f"{summary.pairs} of {summary.planned} pairs are there; dataset sha256 {summary.dataset_sha256}")
    for drop in summary.drops:
        typer.echo(f"frame {drop.frame_index} is missing: {drop.reason}", err=True)
    if summary.drops:
        raise typer.Exit(FAULT)


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


def reproduce(
    dataset: DatasetArgument,
    frame: Annotated[int, typer.Option("--frame", metavar="N", help="Index of the frame.")],
    device: DeviceOption = "cpu",
) -> None:
    """Render one frame of a dataset again, from its manifest alone, and compare record and images.

    On the same processor with the same packages, both must be identical bit for bit. Elsewhere the random draws must be
    equal and the labels agree within 1e-9. The command says which of the two holds, and exits with 1 when neither does.
    Give the --device that made the dataset.
    """
    from droguekit.batch.frame_task import reproduce_frame

    result = reproduce_frame(dataset, frame, device)
    for difference in result.build_differences:
        typer.echo(f"not the same machine: {difference}")
    for difference in result.differences:
        typer.echo(difference)
    if result.verdict == "different":
        typer.echo(f"frame {frame}: is not reproduced")
        raise typer.Exit(FAULT)
    proof = (
        "record and images are the same bit for bit"
        if result.verdict == "identical"
        else "made elsewhere: the draws are equal and the labels agree within 1e-9; pixels were not compared"
    )
    typer.echo(f"frame {frame}: {proof}")
