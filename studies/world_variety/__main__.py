"""Measures the variety of recipes and how a detector finds each kind of drogue, and draws sheets in four lights.

`python -m studies.world_variety measure --out out/world-variety world-89 world-real`
`python -m studies.world_variety detect --detector mobile-s out/world-variety/world-real`
`python -m studies.world_variety sheets --out out/world-variety`
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from drogue_models.presets import preset_names
from drogue_models.tankers.tanker import STATIONS
from droguekit.api.recipe_rendering import load_recipe, render_dataset
from studies.world_variety.detection_by_kind import drogue_kind, score_by_kind
from studies.world_variety.light_sheets import sheet_rows, write_sheet
from studies.world_variety.variety_measures import Variety, measure_variety
from studies.wrong_input import wrong_input_ends

_ROWS_PER_SHEET = 6


def main(arguments: Sequence[str] | None = None) -> None:
    """Render what is missing, then measure it or draw it."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.world_variety",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    measure = commands.add_parser("measure", help="one pair of each of many scenes; a line of numbers for each recipe")
    measure.add_argument("recipes", nargs="+", metavar="RECIPE", help="name of a recipe, or a .toml file")
    measure.add_argument("--scenes", type=int, default=200, metavar="N", help="scenes of each recipe (default 200)")
    sheets = commands.add_parser("sheets", help="every drogue and every tanker at four distances in four lights")
    sheets.add_argument(
        "names", nargs="*", metavar="NAME", help="only these, as `sheets` prints them: fighter-buddy-store (all)"
    )
    detect = commands.add_parser("detect", help="a detector's scores by the kind of drogue")
    detect.add_argument("dataset", type=Path, metavar="DATASET", help="folder of a dataset with its truth")
    detect.add_argument("--detector", default="mobile-s", metavar="NAME", help="a shipped one, or a file (mobile-s)")
    for command in (measure, sheets):
        command.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder; a second run goes on")
        command.add_argument("--workers", type=int, metavar="N", help="processes that render (default: by the machine)")
    options = parser.parse_args(arguments)
    with wrong_input_ends("world_variety"):
        if options.command == "measure":
            _measure(options.recipes, options.scenes, options.out, options.workers)
        elif options.command == "detect":
            _detect(options.dataset, options.detector)
        else:
            _draw_sheets(options.out, options.workers, options.names)


def _measure(names: Sequence[str], scenes: int, out: Path, workers: int | None) -> None:
    # All are read before the first is rendered, which takes hours.
    recipes = [load_recipe(name, frames={"count": scenes, "scenes": scenes}) for name in names]
    print(
        "recipe | pairs | drogues | distance mean | distance p10 | tankers | silhouettes | probes | probe sd x, y [px]"
    )
    for recipe in recipes:
        dataset = render_dataset(recipe, out / recipe.name, workers=workers)
        print(f"{recipe.name} | {_cells(measure_variety(dataset))}", flush=True)


def _cells(found: Variety) -> str:
    x_px, y_px = found.probe_sd_px
    return (
        f"{found.pairs} | {found.drogues} | {found.drogue_distance:.3f} | {found.drogue_distance_p10:.3f} | "
        f"{found.tankers} | {found.silhouettes} | {found.probes} | {x_px:.0f}, {y_px:.0f}"
    )


def _detect(dataset: Path, detector: str) -> None:
    print("drogue | images | drogues | AP50 [%] | recall [%] | false boxes")
    for row in score_by_kind(dataset, detector, drogue_kind):
        shares = (("-" if share is None else f"{100 * share:.1f}") for share in (row.ap50, row.recall))
        print(f"{row.kind} | {row.images} | {row.drogues} | {' | '.join(shares)} | {row.false_boxes}")


def _draw_sheets(out: Path, workers: int | None, names: Sequence[str]) -> None:
    drogues = {name: {"drogue": name} for name in preset_names()}
    tankers = {
        f"{kind}-{station}": {"tanker": {"variants": [{"type": kind, "station": station}]}}
        for kind, stations in STATIONS.items()
        for station in stations
    }
    for name in names:
        if name not in drogues | tankers:
            raise ValueError(f"{name!r} is no subject; there are {', '.join(drogues | tankers)}")
    for subject, everything in (("drogues", drogues), ("tankers", tankers)):
        changes = {name: everything[name] for name in everything if name in names or not names}
        rows = sheet_rows(out / subject, changes, workers, whole_image=subject == "tankers")
        # A sheet of more rows would be too large to look at.
        for number, first in enumerate(range(0, len(rows), _ROWS_PER_SHEET), 1):
            path = out / f"{subject}-{number}.jpg"
            write_sheet(list(rows.values())[first : first + _ROWS_PER_SHEET], path)
            print(f"{path}: {', '.join(list(rows)[first : first + _ROWS_PER_SHEET])}", flush=True)


if __name__ == "__main__":
    main()
