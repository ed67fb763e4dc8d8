"""`python -m studies.engine_agreement`: compare two render engines.

The parts of the comparison run in turn, and each result is kept on disk, so that a stopped run can resume.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import RenderSettings
from droguekit.batch.progress import PlainProgress
from render.engine import RenderEngine, load_engine
from studies.engine_agreement.agreement import (
    Requirement,
    centroid_offset,
    compare_frame,
    cost_line,
    frame_figures,
    frame_head,
    frame_line,
    frame_requirements,
    frame_row,
    navigation_lines,
    navigation_requirements,
    offset_line,
    plate_line,
    plate_requirements,
    requirement_lines,
    write_json,
    write_picture,
)
from studies.engine_agreement.costs import COST_FAMILY, COST_STATIONS_M, CostComparison, cost_from_row, measure_costs
from studies.engine_agreement.measures import (
    TILTS_DEG,
    PlateIlluminance,
    agreement_from_row,
    compare_plate,
    plate_frame,
)
from studies.engine_agreement.navigation_agreement import (
    METHOD,
    RECIPE,
    navigation_table,
    paired_errors,
    pairs_by_station,
    render_paired,
)
from studies.engine_agreement.navigation_agreement import (
    STATIONS_M as NAVIGATION_STATIONS_M,
)
from studies.engine_agreement.paired_frames import (
    FAMILIES,
    STATIONS_M,
    PairedFrame,
    frame_at,
    paired_frames,
    recipe_of_family,
    write_sky_recipe,
)
from studies.wrong_input import wrong_input_ends

Result = dict[str, Any]


class ResultStore:
    """A folder of results; each names the inputs it was computed from, and is valid for these alone."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str, made_from: Result) -> Result | None:
        """The stored result of this name and these inputs, or None."""
        try:
            stored = json.loads(self._file(name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        # As JSON has it: tuples are lists there.
        same = isinstance(stored, dict) and stored.get("made_from") == json.loads(json.dumps(made_from))
        return stored["found"] if same else None

    def keep(self, name: str, made_from: Result, result: Result) -> None:
        """Store a result; the file is written completely or not at all.

        Raises:
            OSError: it cannot be written.
        """
        write_text_atomic(self._file(name), json.dumps({"made_from": made_from, "found": result}, indent=1) + "\n")

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.json"


class Engines:
    """Two engines, loaded when they or their versions are first needed."""

    def __init__(self, names: tuple[str, str]) -> None:
        self.names = names

    @cached_property
    def both(self) -> tuple[RenderEngine, RenderEngine]:
        """The engines.

        Raises:
            ValueError: one cannot be used.
        """
        return load_engine(self.names[0]), load_engine(self.names[1])

    @cached_property
    def compiled(self) -> tuple[RenderEngine, RenderEngine]:
        """The engines after their first pictures, which include compilation."""
        measure_costs(COST_STATIONS_M[0], 0, *self.both)
        return self.both

    @property
    def versions(self) -> list[str]:
        """Versions of both engines, down to the version of their pixels."""
        return [engine.version for engine in self.both]


@dataclass(frozen=True)
class ComparisonRun:
    """One run of the comparison.

    Attributes:
        out: folder for results and pictures.
        engines: the two engines.
        seed: of all frames.
        say: called with a line about each result.
    """

    out: Path
    engines: Engines
    seed: int
    say: Callable[[str], None]

    def frames(self, frames: Sequence[PairedFrame], line: Callable[[Result], str]) -> list[Result]:
        """Every frame by both engines; pictures in `frames`.

        Raises:
            ValueError: an engine cannot render a frame.
            OSError: a result cannot be written.
        """
        rows = []
        for index, paired in enumerate(frames):
            made_from = {"frame_sha256": _sha256(paired.frame.model_dump_json(), paired.settings.model_dump_json())}
            rows.append(self._result(f"frame-{index:03d}", made_from, partial(self._frame, index, paired)))
            self.say(line(rows[-1]))
        return rows

    def _frame(self, index: int, paired: PairedFrame) -> Result:
        compared = compare_frame(paired, *self.engines.both)
        write_picture(self.out / "frames" / f"{index:03d}.png", compared)
        return frame_row(compared)

    def plates(self, samples: int, line: Callable[[PlateIlluminance], str]) -> list[PlateIlluminance]:
        """Illuminance of all plates.

        Raises:
            OSError: a result cannot be written.
        """
        plates = []
        for number, tilt in enumerate(TILTS_DEG):
            frame, settings = plate_frame(samples, tilt)
            made_from = {"frame_sha256": _sha256(frame.model_dump_json(), settings.model_dump_json())}
            row = self._result(f"plate-{number}", made_from, partial(self._plate, tilt, samples))
            plates.append(PlateIlluminance(**row))
            self.say(line(plates[-1]))
        return plates

    def _plate(self, tilt_deg: tuple[float, float], samples: int) -> Result:
        return vars(compare_plate(tilt_deg, samples, *self.engines.both))

    def costs(self, line: Callable[[CostComparison], str]) -> list[CostComparison]:
        """Cost and noise of a pair at all distances, from far to near.

        Raises:
            OSError: a result cannot be written.
        """
        costs = []
        for distance_m in COST_STATIONS_M:
            frame = frame_at(recipe_of_family(COST_FAMILY, self.seed), distance_m, 1, 0)
            made_from = {"distance_m": distance_m, "sha256": _sha256(frame.model_dump_json(), str(RenderSettings()))}
            row = self._result(f"cost-{distance_m:g}m", made_from, partial(self._cost, distance_m))
            costs.append(cost_from_row(row))
            self.say(line(costs[-1]))
        return costs

    def _cost(self, distance_m: float) -> Result:
        return measure_costs(distance_m, self.seed, *self.engines.compiled).row()

    def _result(self, name: str, made_from: dict[str, Any], compute: Callable[[], Result]) -> Result:
        store = ResultStore(self.out / "found")
        whole = made_from | {"engines": self.engines.versions}
        stored = store.get(name, whole)
        if stored is not None:
            return stored
        result = compute()
        store.keep(name, whole, result)
        return result


def _sha256(*texts: str) -> str:
    return hashlib.sha256("".join(texts).encode()).hexdigest()


_EXAMPLES = """Examples:

  python -m studies.engine_agreement

  python -m studies.engine_agreement --part frames --family world-89/dusk --station 5 --count 1"""


class ComparisonPart(StrEnum):
    """A part of the comparison."""

    FRAMES = "frames"
    PLATES = "plates"
    COST = "cost"
    NAVIGATION = "navigation"


def main(
    out: Annotated[
        Path, typer.Option("--out", help="Folder for numbers and pictures; results that are there are kept.")
    ] = Path("out/engine-agreement"),
    part: Annotated[
        list[ComparisonPart] | None, typer.Option("--part", help="Part of the comparison; repeatable; default all.")
    ] = None,
    engine: Annotated[tuple[str, str], typer.Option("--engines", help="The two engines.")] = ("mitsuba", "blender"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of all frames.")] = 20,
    count: Annotated[
        int | None, typer.Option("--count", min=1, help="Number of frames; default one of each family.")
    ] = None,
    family: Annotated[
        list[str] | None, typer.Option("--family", help="A recipe, or recipe/family; repeatable.")
    ] = None,
    station: Annotated[list[float] | None, typer.Option("--station", help="Distance in metres; repeatable.")] = None,
    samples: Annotated[int, typer.Option("--samples", min=4, help="Most samples per pixel of a frame.")] = 64,
    plate_samples: Annotated[int, typer.Option("--plate-samples", min=1, help="Samples per pixel of a plate.")] = 256,
    pairs: Annotated[int, typer.Option("--pairs", min=14, help="Number of pairs for navigation.")] = 100,
) -> None:
    """Render the same frames by two engines, and report their differences.

    Exits with 1 when a requirement is missed. A run that was stopped resumes where it was.
    """
    cv2.setNumThreads(1)
    chosen = part or [*ComparisonPart]
    run = ComparisonRun(out, Engines(engine), seed, typer.echo)
    tables: dict[str, Any] = {}
    requirements: list[Requirement] = []
    with wrong_input_ends("engine_agreement"):
        if ComparisonPart.FRAMES in chosen:
            families = family or [*FAMILIES, str(write_sky_recipe(out / "own-sky"))]
            frames = paired_frames(families, station or STATIONS_M, count or len(families), samples, seed)
            typer.echo(frame_head())
            rows = run.frames(frames, lambda row: frame_line(_figures(row)))
            tables["frames"] = [_figures(row) for row in rows]
            agreements = [agreement_from_row(row["agreement"]) for row in rows]
            offset = centroid_offset(agreements)
            if offset is not None:
                tables["centroid_offset"] = asdict(offset)
                typer.echo(offset_line(offset))
            requirements += frame_requirements(agreements, [f.distance_m for f in frames])
        if ComparisonPart.PLATES in chosen:
            plates = run.plates(plate_samples, plate_line)
            tables["plates"] = [vars(plate) for plate in plates]
            requirements += plate_requirements(plates)
        if ComparisonPart.COST in chosen:
            tables["costs"] = [cost.row() for cost in run.costs(cost_line)]
        if ComparisonPart.NAVIGATION in chosen:
            requirements += _navigation(out / "navigation", engine, seed, pairs, tables)
        write_json(out, tables, requirements)
    typer.echo("\n".join([*requirement_lines(requirements), f"numbers and pictures are in {out}"]))
    raise typer.Exit(0 if all(requirement.reached for requirement in requirements) else 1)


def _figures(row: dict[str, Any]) -> dict[str, Any]:
    return frame_figures(row, agreement_from_row(row["agreement"]))


def _navigation(
    out: Path, engines: tuple[str, str], seed: int, pairs: int, tables: dict[str, Any]
) -> Sequence[Requirement]:
    """Render and navigate at every distance; fills in the table."""
    stations = []
    for station_m, count in pairs_by_station(NAVIGATION_STATIONS_M, pairs).items():
        paired = render_paired(out, engines, station_m, count, seed, PlainProgress(sys.stdout))
        stations.append(paired_errors(paired))
    typer.echo("\n".join(navigation_lines(stations)))
    tables["navigation"] = {"method": METHOD, "recipe": RECIPE} | navigation_table(stations)
    return navigation_requirements(stations)


if __name__ == "__main__":
    app = typer.Typer(add_completion=False)
    app.command(epilog=_EXAMPLES)(main)
    app()
