"""Measures speed-up and overhead of several workers: two against one, and the cost of a frame besides its rendering.

Run as `python -m studies.scaling --out out/scaling` on a machine that does nothing else. A stopped run
continues: results in `results.json` of that folder are not measured again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage.layout import EVENTS_FILE
from droguekit.batch.progress import ProgressReport, progress_report
from studies.scaling.spreading_cost import children_cpu_s, dask_cost, local_cost

RESULTS_FILE = "results.json"
# All pairs cost about the same; only the distance varies, over the whole range.
UNIFORM_RECIPE = """
name = "uniform"
seed = 1
rig = "rgb-ideal"
[frames]
count = {pairs}
scenes = 8
[distance]
law = "uniform"
low_m = 2.0
high_m = 40.0
"""
_BUSY_LOAD = 0.3


def speed(recipe_text: str, workers: int, folder: Path, report: ProgressReport) -> dict[str, Any]:
    """Time that the whole command takes to make a dataset.

    Args:
        recipe_text: the recipe.
        workers: how many processes.
        folder: for the dataset; emptied first.
        report: of progress.

    Returns:
        Seconds on the clock and CPU seconds of all its processes, those of making frames and of the frames' own
        stages, and how many frames there are.

    Raises:
        OSError: the command failed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "recipe.toml").write_text(recipe_text, encoding="utf-8")
    report.say(f"{parse_recipe(recipe_text).frames.count} pairs by {workers}")
    arguments = ["render", str(folder / "recipe.toml"), "--out", str(folder / "dataset"), "--workers", str(workers)]
    before_s, began_s = children_cpu_s(), time.monotonic()
    ended = subprocess.run([sys.executable, "-m", "droguekit.cli.main", *arguments])
    wall_s, cpu_s = time.monotonic() - began_s, children_cpu_s() - before_s
    if ended.returncode != 0:
        raise OSError(f"{folder}: droguekit render ended with exit code {ended.returncode}")
    events = [json.loads(line) for line in (folder / "dataset" / EVENTS_FILE).read_text("utf-8").splitlines()]
    end = events[-1]
    cost = {"wall_s": wall_s, "cpu_s": cpu_s, "frames_cpu_s": sum(end["stage_s"].values())}
    return {"workers": workers, "pairs": end["made"], **cost}


def measure(out: Path, pairs: int, tasks: int, parts: tuple[str, ...], report: ProgressReport) -> dict[str, Any]:
    """Measure the requested parts that have no result yet.

    Args:
        out: folder of the results.
        pairs: of the datasets by which speed is measured.
        tasks: that do nothing, by which the cost of spreading is measured.
        parts: of `speed`, `local`, `dask`.
        report: of progress.

    Returns:
        All results in the folder by their names.

    Raises:
        OSError: a process failed, or the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    known = _known(out / RESULTS_FILE)
    recipe_text = UNIFORM_RECIPE.format(pairs=pairs)
    planned: dict[str, tuple[str, Callable[[], Mapping[str, Any]]]] = {
        f"{pairs} pairs, 1 worker": ("speed", lambda: speed(recipe_text, 1, out / "one", report)),
        f"{pairs} pairs, 2 workers": ("speed", lambda: speed(recipe_text, 2, out / "two", report)),
        f"{tasks} empty frames, 2 workers here": ("local", lambda: local_cost(out / "empty", tasks, 2, report)),
        f"{tasks} empty frames, Dask, 2 workers": ("dask", lambda: dask_cost(out / "empty", tasks, 2, report)),
    }
    missing = {name: work for name, (part, work) in planned.items() if part in parts and name not in known}
    if any(name.startswith(f"{pairs} pairs") for name in missing):
        # Compiled kernels are cached on disk, which would favour the second run.
        speed(UNIFORM_RECIPE.format(pairs=6), 2, out / "warm", report)
    for name, work in missing.items():
        load = os.getloadavg()[0]
        if load > _BUSY_LOAD:
            report.say(
                f"the machine is busy with other work (load {load:.1f}): of the following results only CPU time counts"
            )
        known[name] = dict(work())
        write_text_atomic(out / RESULTS_FILE, json.dumps(known, indent=1) + "\n")
    return known


def table(results: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The results as lines of text."""
    lines = []
    speeds = [result for result in results.values() if "cpu_s" in result]
    if speeds:
        lines.append(f"{'pairs':>6} {'workers':>8} {'wall s':>8} {'CPU s':>8} {'CPU s/pair':>11} {'cores':>6} speed-up")
    for result in speeds:
        alone_s = [other["wall_s"] for other in speeds if (other["workers"], other["pairs"]) == (1, result["pairs"])]
        gain = f"{alone_s[0] / result['wall_s']:8.2f}" if alone_s else ""
        lines.append(
            f"{result['pairs']:6d} {result['workers']:8d} {result['wall_s']:8.1f} {result['cpu_s']:8.1f} "
            f"{result['frames_cpu_s'] / result['pairs']:11.2f} {result['cpu_s'] / result['wall_s']:6.2f} {gain}"
        )
    for name, result in results.items():
        if "cpu_ms" not in result:
            continue
        cpu_ms = result["cpu_ms"]
        shares = ", ".join(f"{who} {spent:.2f}" for who, spent in cpu_ms.items())
        lines.append(f"{name}: CPU ms a frame {sum(cpu_ms.values()):.2f} ({shares}), wall {result['wall_ms']:.2f} ms")
        memory = ", ".join(f"{mib:.0f} after {count}" for count, mib in result["client_mib"].items())
        lines.append(f"  memory of the client [MiB]: {memory}")
    return lines


def _known(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return {}


def main() -> int:
    """Measure, and print all that is known."""
    parser = argparse.ArgumentParser(prog="python -m studies.scaling", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for datasets and results")
    parser.add_argument("--pairs", type=int, default=200, help="of the datasets by which speed is measured")
    parser.add_argument("--frames", type=int, default=5000, help="empty ones, by which overhead is measured")
    parts = ("speed", "local", "dask")
    parser.add_argument("--part", action="append", choices=parts, help="only this one; may be repeated")
    arguments = parser.parse_args()
    try:
        if arguments.pairs < 1 or arguments.frames < 1:
            raise ValueError("--pairs, --frames: must be at least 1")
        wanted = tuple(arguments.part or parts)
        results = measure(arguments.out, arguments.pairs, arguments.frames, wanted, progress_report())
    except (ValueError, OSError) as error:
        print(f"scaling: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("scaling: interrupted; the same command continues from the finished results", file=sys.stderr)
        return 130
    print("\n".join(table(results)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
