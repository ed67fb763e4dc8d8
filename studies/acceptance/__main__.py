"""Command line of the acceptance study.

Measures a tier of the acceptance criteria: renders, navigates, scores and writes the table.

Packages are imported where they are used, so that `--help` stays fast.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from datasets_manifest.recipe.recipe import RecipeSource
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import progress_report
from droguekit.cli.arguments import WorkersOption
from droguekit.cli.main import FAULT, run
from droguekit.workflows.benchmarking import benchmark_dataset
from droguekit.workflows.navigation import NavigationOptions, navigate_dataset
from droguekit.workflows.rendering import open_recipe, render_frames
from studies.acceptance.rendered.image_tiers import IMAGE_TIERS, LightLevel, TierData, recipe_of

if TYPE_CHECKING:
    from datasets_manifest.recipe.recipe import Recipe
    from droguekit.batch.progress import ProgressReport
    from studies.acceptance.acceptance_table import AcceptanceRow, AcceptanceTable
    from studies.acceptance.rendered.flight_tiers import FlightData


DEFAULT_TRACKER, DEFAULT_RIG = "pose-predict", "rgb-ideal"
# Engine and recipe name the data that the criteria judge; a third name is that of another rig.
_NAMES_OF_CRITERIA = 2
# Pairs at each distance whose centroids are timed.
_TIMED_PAIRS = 8


@dataclass(frozen=True)
class FlightOptions:
    """What to measure of the tiers `e` and `docking`, and with which rigs and tracker.

    Attributes:
        recipes: names of the tier's recipes to use; all when empty.
        rigs: camera rigs. The criteria judge `rgb-ideal`; figures of other rigs are given for comparison. Recipes of a
            bench ignore this.
        sequences: of each recipe; as many as a full measurement takes when None.
        tracker: name.
    """

    recipes: tuple[str, ...] = ()
    rigs: tuple[str, ...] = (DEFAULT_RIG,)
    sequences: int | None = None
    tracker: str = DEFAULT_TRACKER


@dataclass(frozen=True)
class AcceptanceOptions:
    """Which criteria to measure, and how much to spend on them.

    Attributes:
        tier: `a`, `b`, `c`, `d`, `e`, `docking` or `speed`.
        seed: of all draws.
        pairs_per_station: rendered pairs at each distance, the recipe's when None; tiers a and b.
        draws: frames of a cell, the protocol's when None; tiers c and d, and speed.
        engines: that render; empty means those of the recipes. Tiers b, e and docking.
        lights: to measure by, in tiers a and b.
        workers: rendering processes; None means as many as the machine has memory for.
        flights: of the tiers e and docking.
    """

    tier: str
    seed: int
    pairs_per_station: int | None = None
    draws: int | None = None
    engines: tuple[str, ...] = ()
    lights: tuple[LightLevel, ...] = tuple(LightLevel)
    workers: int | None = None
    flights: FlightOptions = FlightOptions()


def measure_tier(options: AcceptanceOptions, out: Path, report: ProgressReport) -> AcceptanceTable:
    """Measure the criteria of a tier and write bars.json and bars.md; finished results of an earlier run are kept.

    Raises:
        ValueError: no such tier, a number out of range, or a folder with other content.
        OSError: the folder cannot be written.
    """
    from importlib.metadata import version

    from datasets_manifest.atomic import write_text_atomic
    from studies.acceptance.acceptance_table import AcceptanceTable
    from studies.acceptance.centroid_level.centroid_tiers import measure_speed, measure_tier_c, measure_tier_d
    from studies.acceptance.rendered.flight_tiers import FLIGHT_TIERS

    drawn = {"c": measure_tier_c, "d": measure_tier_d}
    if options.tier in IMAGE_TIERS:
        rows = measure_image_tier(options, out, report)
    elif options.tier in drawn:
        rows = drawn[options.tier](out, options.seed, options.draws, report)
    elif options.tier == "speed":
        rows = measure_speed(_timed_pairs(options, out, report), options.seed, options.draws, report)
    elif options.tier in FLIGHT_TIERS:
        rows = measure_flight_tier(options, FLIGHT_TIERS[options.tier], out, report)
    else:
        tiers = ", ".join((*IMAGE_TIERS, *drawn, *FLIGHT_TIERS, "speed"))
        raise ValueError(f"tier: there is none named {options.tier!r}; there are {tiers}")
    table = AcceptanceTable(tier=options.tier, seed=options.seed, code_version=version("droguekit"), rows=tuple(rows))
    write_text_atomic(out / "bars.json", table.to_json())
    write_text_atomic(out / "bars.md", table.to_markdown())
    return table


@dataclass(frozen=True)
class PlannedData:
    """One dataset that is to be made, from options that were checked.

    Attributes:
        source: the recipe.
        count: number of pairs, from the first on.
        names: of engine, recipe or light, and rig, where several are measured; they make up folder and title.
    """

    source: RecipeSource
    count: int
    names: tuple[str, ...]


def measure_image_tier(options: AcceptanceOptions, out: Path, report: ProgressReport) -> list[AcceptanceRow]:
    """Measure the criteria of tier `a` or `b`, engine by engine and light by light.

    Raises:
        ValueError: no such engine, a wrong number, or pairs that could not be made.
        OSError: the folder cannot be written.
    """
    from studies.acceptance.rendered.scored_frames import METHODS

    plans = plan_images(options)
    _check_engines([plan for _, plan in plans])
    rows: list[AcceptanceRow] = []
    for light, plan in plans:
        folder = out.joinpath(*plan.names)
        sha256 = _render(plan, folder, options, report)
        estimates = _navigated(folder, "estimates", sha256, METHODS, NavigationOptions(), report)
        result = benchmark_dataset(folder / "dataset", estimates, folder / "benchmark.json", folder / "report.html")
        measured = IMAGE_TIERS[options.tier](TierData(light, folder / "dataset", estimates, result))
        by_engine = "".join(f"{name}, " for name in plan.names[:-1])
        rows += [row.model_copy(update={"quantity": by_engine + row.quantity}) for row in measured]
    return rows


def plan_images(options: AcceptanceOptions) -> list[tuple[LightLevel, PlannedData]]:
    """The datasets to make; an engine that is asked for by name has folders of its own.

    Raises:
        ValueError: no such engine, or a wrong number.
    """
    plans = []
    for engine in options.engines or (None,):
        for light in options.lights:
            source = open_recipe(recipe_of(options.tier, light), options.seed, engine)
            recipe = source.recipe
            stations = len(recipe.distance.stations_m or ())
            most = recipe.frames.count // stations
            pairs = most if options.pairs_per_station is None else options.pairs_per_station
            if not 1 <= pairs <= most:
                raise ValueError(f"--pairs-per-station: must be from 1 to {most}, got {pairs}")
            names = (light,) if engine is None else (engine, light)
            plans.append((light, PlannedData(source, stations * pairs, names)))
    return plans


def _timed_pairs(options: AcceptanceOptions, out: Path, report: ProgressReport) -> Path:
    """A dataset of analytic pairs by day at every distance."""
    source = open_recipe(recipe_of("a", "day"), options.seed, None)
    plan = PlannedData(source, _TIMED_PAIRS * len(source.recipe.distance.stations_m or ()), ())
    _render(plan, out, options, report)
    return out / "dataset"


def measure_flight_tier(
    options: AcceptanceOptions, data: Sequence[FlightData], out: Path, report: ProgressReport
) -> list[AcceptanceRow]:
    """Measure the criteria of whole flights, dataset by dataset; wrong options are found before anything is made.

    Raises:
        ValueError: no such recipe in the tier, engine, rig or tracker, a wrong number, or pairs that could not be made.
        OSError: the folder cannot be written.
    """
    from nav.tracking.tracker import tracker_names

    if options.flights.tracker not in tracker_names():
        raise ValueError(f"--tracker: must be one of {', '.join(tracker_names())}, got {options.flights.tracker!r}")
    plans = plan_flights(options, data)
    _check_engines([plan for _, plan in plans])
    return [row for each, plan in plans for row in _flight_rows(options, each, plan, out, report)]


def plan_flights(options: AcceptanceOptions, data: Sequence[FlightData]) -> list[tuple[FlightData, PlannedData]]:
    """The datasets to make.

    The first sequences of a recipe do not depend on how many are asked for, up to a full measurement.

    Raises:
        ValueError: no such recipe in the tier, engine or rig, or a wrong number.
    """
    from studies.acceptance.rendered.flight_tiers import part_length, with_parts

    flights, names = options.flights, [each.recipe for each in data]
    for name in flights.recipes:
        if name not in names:
            raise ValueError(f"--recipe: {options.tier} has none named {name!r}; there are {', '.join(names)}")
    if flights.sequences is not None and flights.sequences < 1:
        raise ValueError(f"--sequences: must be at least 1, got {flights.sequences}")
    plans = []
    for each in data:
        if flights.recipes and each.recipe not in flights.recipes:
            continue
        parts = each.parts if flights.sequences is None else flights.sequences
        for engine in options.engines or (None,):
            source = open_recipe(each.recipe, options.seed, engine)
            recipe = with_parts(source.recipe, max(each.parts, parts))
            for rig in flights.rigs if each.follows else (DEFAULT_RIG,):
                made = recipe.render.engine, recipe.name, *([] if rig == DEFAULT_RIG else [rig])
                seen = RecipeSource(_with_rig(recipe, rig), source.text)
                plans.append((each, PlannedData(seen, parts * part_length(recipe), made)))
    return plans


def _flight_rows(
    options: AcceptanceOptions, data: FlightData, plan: PlannedData, out: Path, report: ProgressReport
) -> list[AcceptanceRow]:
    """The rows of one dataset."""
    from nav.runner import method_names
    from studies.acceptance.rendered.flight_tiers import processing_time_rows, tracking_filter_rows
    from studies.acceptance.rendered.scored_frames import BEST, METHODS
    from studies.acceptance.rendered.sequence_pairs import FILTERED, score_pairs

    title, folder, is_comparison = (
        ", ".join(plan.names),
        out.joinpath(*plan.names),
        len(plan.names) > _NAMES_OF_CRITERIA,
    )
    sha256 = _render(plan, folder, options, report)
    tracked = NavigationOptions(tracker=options.flights.tracker, filtered=True) if data.follows else NavigationOptions()
    estimates = _navigated(folder, "estimates", sha256, METHODS, tracked, report)
    result = benchmark_dataset(folder / "dataset", estimates, folder / "benchmark.json", folder / "report.html")
    scores = score_pairs(folder / "dataset", estimates)
    # The paper's method reports no covariance, so there is no filtered version of it.
    scores = {name: scores[name] for name in (*METHODS, FILTERED) if name in scores}
    rows = data.rows(title, scores, is_comparison)
    if data.follows:
        rows += tracking_filter_rows(title, scores, result)
    untracked = f"{title}, detector at every pair"
    if data.times:
        rows += processing_time_rows(f"{title}, {options.flights.tracker}", scores[FILTERED], is_comparison)
        alone = _navigated(folder, "detector-alone", sha256, (BEST,), NavigationOptions(filtered=True), report)
        rows += processing_time_rows(untracked, score_pairs(folder / "dataset", alone)[FILTERED], True)
    if data.compares:
        # A separate run: the times above must not include other methods.
        all_methods = _navigated(folder, "all-methods", sha256, method_names(), NavigationOptions(), report)
        rows += data.rows(untracked, score_pairs(folder / "dataset", all_methods), True)
    return rows


def _check_engines(plans: Sequence[PlannedData]) -> None:
    """Check that every engine can be loaded.

    Raises:
        ValueError: one is unknown or not installed.
    """
    from render.engine import load_engine

    for name in dict.fromkeys(plan.source.recipe.render.engine for plan in plans):
        load_engine(name)


def _with_rig(recipe: Recipe, rig: str) -> Recipe:
    """The recipe with another of the shipped rigs and the recipe's own stray light; the default rig changes nothing.

    Raises:
        ValueError: no such rig, or one that the engine cannot draw.
    """
    from pydantic import ValidationError

    from datasets_manifest.recipe.recipe import Recipe
    from datasets_manifest.recipe.rigs import resolve_rig
    from drogue_models.presets import explain

    if rig == DEFAULT_RIG:
        return recipe
    try:
        seen_by, sensor = resolve_rig(rig, recipe.seed)
        clean = {"scattered_fraction": recipe.sensor.optics.scattered_fraction}
        sensor = sensor.model_copy(update={"optics": sensor.optics.model_copy(update=clean)})
        return Recipe.model_validate(dict(recipe) | {"rig": seen_by, "sensor": sensor})
    except ValidationError as error:
        raise ValueError(f"--rig {rig}: {explain(error)}") from error
    except ValueError as error:
        raise ValueError(f"--rig {rig}: {error}") from error


def _render(plan: PlannedData, folder: Path, options: AcceptanceOptions, report: ProgressReport) -> str:
    """Render what is missing of a dataset's first pairs, and return the dataset's hash.

    Raises:
        ValueError: pairs could not be rendered; leaving them out would flatter the results.
    """
    dataset = folder / "dataset"
    report.say(f"{folder.name}: rendering {plan.count} pairs of {plan.source.recipe.name} into {dataset}")
    made = render_frames(plan.source, dataset, range(plan.count), ExecutionOptions(options.workers), report)
    if made.drops:
        first = min(made.drops, key=lambda drop: drop.frame_index)
        raise ValueError(
            f"{dataset}: {len(made.drops)} pairs could not be made, pair {first.frame_index} the first: "
            f"{first.reason}; the criteria count every pair: change the recipe or the seed, or run it again if "
            "the failure was an accident"
        )
    return made.dataset_sha256


def _navigated(
    folder: Path, name: str, sha256: str, methods: Sequence[str], how: NavigationOptions, report: ProgressReport
) -> Path:
    """Estimates of a folder's dataset, made unless a file from the same methods and options is there already."""
    from studies.acceptance.finished_results import is_navigated, mark_navigated

    estimates = folder / f"{name}.jsonl"
    made_with = [*methods, *([f"tracker {how.tracker}"] if how.tracker else []), *(["filter"] if how.filtered else [])]
    if is_navigated(estimates, sha256, made_with):
        report.say(f"{folder.name}: {estimates} exists already")
        return estimates
    navigate_dataset(folder / "dataset", methods, estimates, report, how)
    mark_navigated(estimates, sha256, made_with)
    return estimates


EXAMPLES = (
    "python -m studies.acceptance c --out out/bars/c",
    "python -m studies.acceptance a --out out/bars/a --pairs-per-station 20   (a first look)",
    "python -m studies.acceptance b --out out/bars/b --light day   (the other one can follow)",
    "python -m studies.acceptance d --out /tmp/d --draws 50 --seed 7",
    "python -m studies.acceptance speed --out /tmp/speed",
    "python -m studies.acceptance e --out out/bars/e",
    "python -m studies.acceptance b --out out/bars/b --engine blender",
    "python -m studies.acceptance docking --out out/bars/docking --engine mitsuba --engine blender",
    "python -m studies.acceptance docking --out /tmp/docking --recipe docking-10m --sequences 1 --rig rgb-ideal",
)
_IMAGE_TIERS, _FLIGHT_TIERS = ("a", "b"), ("e", "docking")


def acceptance(
    tier: Annotated[
        str,
        typer.Argument(
            metavar="TIER",
            help="a: analytic images, b: path-traced images, c: centroid noise and tolerances, d: bad markers, "
            "e: swing sequences, docking: whole flights and the paper's bench, speed.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Gets bars.json and bars.md, and keeps finished results.")
    ],
    pairs_per_station: Annotated[
        int | None, typer.Option("--pairs-per-station", help="Tiers a and b: pairs at each distance; all by default.")
    ] = None,
    light: Annotated[
        list[LightLevel] | None, typer.Option("--light", help="Tiers a and b: only this light level; both by default.")
    ] = None,
    draws: Annotated[
        int | None, typer.Option("--draws", help="Tiers c and d: frames a cell; the protocol's by default.")
    ] = None,
    recipe: Annotated[
        list[str] | None,
        typer.Option("--recipe", metavar="NAME", help="Tiers e and docking: only this recipe; may be repeated."),
    ] = None,
    sequences: Annotated[
        int | None,
        typer.Option(
            "--sequences",
            help="Tiers e and docking: of each recipe, or parts of 90 pairs of a bench; a full measurement by default.",
        ),
    ] = None,
    engine: Annotated[
        list[str] | None,
        typer.Option(
            "--engine", metavar="NAME", help="Tiers b, e and docking: instead of the recipe's; may be repeated."
        ),
    ] = None,
    rig: Annotated[
        list[str] | None,
        typer.Option(
            "--rig",
            metavar="NAME",
            help=f"Tiers e and docking: may be repeated; by default {DEFAULT_RIG}. Others are for comparison.",
        ),
    ] = None,
    tracker: Annotated[
        str | None,
        typer.Option(
            "--tracker", metavar="NAME", help=f"Tiers e and docking: in the loop; {DEFAULT_TRACKER} by default."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all draws; 1 is for development.")] = 1,
    workers: WorkersOption = None,
) -> None:
    """Measure the acceptance criteria of a tier: required value, measured value, its 95 % limit, met or not.

    A run that was stopped continues from its finished results; results of other code are measured again. Exit code 1
    means that a criterion is missed.
    """
    has_images, has_flights = tier in _IMAGE_TIERS, tier in _FLIGHT_TIERS
    if (has_images or has_flights) and draws is not None:
        raise ValueError("--draws: is for tiers c and d and speed; the others take --pairs-per-station or --sequences")
    if not has_images and pairs_per_station is not None:
        raise ValueError("--pairs-per-station: is for tiers a and b; the others take --draws or --sequences")
    if not has_images and light is not None:
        raise ValueError("--light: is for tiers a and b; the others have no day and dusk")
    if not has_flights and any(value is not None for value in (recipe, sequences, rig, tracker)):
        raise ValueError("--recipe, --sequences, --rig, --tracker: are for tiers e and docking")
    if engine is not None and not (has_flights or tier == "b"):
        raise ValueError("--engine: is for tiers b, e and docking; tier a is of analytic images")
    if draws is not None and draws < 2:
        raise ValueError(f"--draws: must be at least 2, got {draws}")
    flights = FlightOptions(
        recipes=tuple(dict.fromkeys(recipe or ())),
        rigs=tuple(dict.fromkeys(rig or (DEFAULT_RIG,))),
        sequences=sequences,
        tracker=tracker or DEFAULT_TRACKER,
    )
    options = AcceptanceOptions(
        tier=tier,
        seed=seed,
        pairs_per_station=pairs_per_station,
        draws=draws,
        engines=tuple(dict.fromkeys(engine or ())),
        lights=tuple(dict.fromkeys(light or LightLevel)),
        workers=workers,
        flights=flights,
    )
    table = measure_tier(options, out, progress_report())
    for line in table.to_lines():
        typer.echo(line)
    typer.echo(f"wrote {out / 'bars.json'} and {out / 'bars.md'}")
    if table.missed:
        typer.echo(f"{table.missed} criteria are missed", err=True)
        raise typer.Exit(FAULT)


def run_command(arguments: list[str]) -> int:
    """Run the command line of the acceptance study, and return its exit code."""
    command = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    command.command(epilog="\n".join(["\b", "Examples:", *(f"  {line}" for line in EXAMPLES)]))(acceptance)
    return run(arguments, command, "python -m studies.acceptance")


if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:]))
