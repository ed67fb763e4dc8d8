"""Measures what the commands take on a dataset of very many pairs: processor time, memory and time by the clock.

Run as `python -m studies.scaling.large_dataset --records 10000 --out out/large`. A few tiny pairs are rendered and
repeated under new indices, their pictures hard-linked. A stopped run continues: what is there is not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import part_path
from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage.layout import RECIPE_FILE, RECORD_FILE, frame_folder
from datasets_manifest.storage.manifest import build_manifest, read_manifest, write_manifest
from datasets_manifest.storage.writer import canonical_json
from drogue_models.untrusted_files import parse_json
from droguekit.batch.progress import ProgressReport, progress_report
from droguekit.batch.render_dataset import render_dataset
from droguekit.batch.resume import open_dataset
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scenes
from studies.stored_figures import RENDER_COMMAND, read_results, rendering_build, write_results
from studies.wrong_input import wrong_input_ends

RESULTS_FILE = "large.json"
PAIRS = 40
RECIPE = """
name = "large"
seed = 1
rig = {{ preset = "rgb-ideal", width_px = 96, height_px = 72, focal_px = 160.0 }}
frames = {{ count = {count}, scenes = 8, empty_fraction = 0.1 }}
distance = {{ law = "uniform", low_m = 2.0, high_m = 20.0 }}
environment = {{ ground = "sea" }}
render = {{ engine = "analytic" }}
split = {{ train = 0.5, val = 0.25, test = 0.25 }}
"""
# The memory of a process counts from that of the one which starts it, so a small one starts each command.
_STARTER = """
import json, os, resource, sys, time
began_s = time.monotonic()
pid = os.fork()
if pid == 0:
    os.execv(sys.argv[1], sys.argv[1:])
_, status, used = os.wait4(pid, 0)
cost = {"cpu_s": used.ru_utime + used.ru_stime, "peak_mb": used.ru_maxrss * 1024 / 1e6,
        "wall_s": time.monotonic() - began_s, "exit_code": os.waitstatus_to_exitcode(status)}
print("\\n" + json.dumps(cost))
"""
# Until the first picture of the list is there, and until the list follows what was typed.
_TIME_TILES = """
async () => {
  const settled = () => document.querySelector("#tiles img").decode();
  await settled();
  const first_tile_s = performance.now() / 1e3;
  const field = document.querySelector("[name=text]");
  const began = performance.now();
  for (const text of ["v", "va", "val"]) {
    field.value = text;
    field.dispatchEvent(new Event("input", { bubbles: true }));
  }
  await settled();
  return { first_tile_s, letter_s: (performance.now() - began) / 3e3 };
}
"""


@dataclass(frozen=True)
class CommandCost:
    """What a command took: processor time of its processes, memory of the largest of them, time by the clock."""

    records: int
    command: str
    cpu_s: float
    peak_mb: float
    wall_s: float


def build_dataset(out: Path, records: int, pairs: int, report: ProgressReport) -> Path:
    """Make the missing frames of a dataset, of which only `pairs` are rendered, and its manifest.

    Returns:
        The dataset's folder in the folder `out` of the study.

    Raises:
        OSError: it cannot be written.
    """
    few, dataset = out / f"few-{pairs}", out / f"{records}"
    render_dataset(_source(pairs), few, range(pairs), 0, report)
    tables = [parse_json((frame_folder(few, index) / RECORD_FILE).read_bytes()) for index in range(pairs)]
    report.say(f"repeating {pairs} pairs into {records}")
    with open_dataset(dataset, source := _source(records)):
        for index in range(records):
            if not frame_folder(dataset, index).exists():
                _repeat(frame_folder(few, index % pairs), tables[index % pairs], dataset, index)
        if read_manifest(dataset).counts.pairs < records:
            splits = split_of_scenes(source.recipe)
            write_manifest(dataset, build_manifest(dataset, source.recipe, RENDER_VERSION, splits))
    return dataset


def _source(records: int) -> RecipeSource:
    text = RECIPE.format(count=records)
    return RecipeSource(parse_recipe(text), text)


def _repeat(frame: Path, table: dict[str, Any], dataset: Path, index: int) -> None:
    part = part_path(frame_folder(dataset, index))
    part.mkdir(parents=True)
    for name in table["file_sha256"]:
        os.link(frame / name, part / name)
    own = {**table, "frame_index": index, "frame": {**table["frame"], "frame_index": index}}
    (part / RECORD_FILE).write_text(canonical_json(own) + "\n", encoding="utf-8")
    part.rename(frame_folder(dataset, index))


def command_cost(records: int, name: str, arguments: Sequence[str]) -> CommandCost:
    """What `droguekit` with these arguments takes in a process of its own.

    Raises:
        OSError: the command failed.
    """
    command = [sys.executable, "-m", "droguekit.cli.main", *arguments]
    starter = [sys.executable, "-I", "-S", "-c", _STARTER]
    ran = subprocess.run([*starter, *command], capture_output=True, text=True, check=True)
    cost = json.loads(ran.stdout.splitlines()[-1])
    # Coverage ends with 1 where cells lack pairs, as they do here.
    if cost.pop("exit_code") not in (0, 1):
        raise OSError(f"droguekit {' '.join(arguments)} failed: {ran.stderr.strip()[-500:]}")
    return CommandCost(records, name, **cost)


def page_cost(page: Path, picture: Path) -> dict[str, float]:
    """What a page of `droguekit browse` takes in a browser, which needs playwright; a PNG file gets what it shows.

    Returns:
        `first_tile_s` from the call to the first picture, `letter_s` for each letter typed into the text filter, and
        `peak_mb`, the most memory of the tab's process.
    """
    from playwright.sync_api import sync_playwright

    from droguekit.visualization.print_pdf import find_browser

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_browser(), args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 1280, "height": 900})
        tab.set_default_timeout(600_000)
        tab.goto(page.resolve().as_uri())
        times: dict[str, float] = tab.evaluate(_TIME_TILES)
        tab.screenshot(path=picture)
        processes = browser.new_browser_cdp_session().send("SystemInfo.getProcessInfo")["processInfo"]
        tabs = [Path(f"/proc/{one['id']}/status").read_text() for one in processes if one["type"] == "renderer"]
        times["peak_mb"] = max(int(text.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6 for text in tabs)
        browser.close()
    return times


def measure(dataset: Path, records: int, only: Sequence[str], report: ProgressReport) -> list[CommandCost]:
    """Measure the commands that have no result yet: those named in `only`, or all.

    Args:
        dataset: that `build_dataset` made; results are beside it.
        records: pairs of the dataset.
        only: names of commands; empty for all.
        report: is told of the progress.

    Returns:
        The costs that are known for this number of pairs.

    Raises:
        ValueError: the results beside the dataset are damaged; names the file.
        OSError: a command failed, or the folder cannot be written.
    """
    results = dataset.parent / RESULTS_FILE
    build = rendering_build((*RENDER_COMMAND, "studies.scaling"))
    known = {key: CommandCost(**cost) for key, cost in read_results(results, build, report).items()}
    commands = _commands(dataset, dataset.parent / f"{records}-made")
    for name, arguments in commands.items():
        if (only and name not in only) or f"{records} {name}" in known:
            continue
        if "--out" in arguments and name != "render":
            shutil.rmtree(arguments[-1], ignore_errors=True)
        report.say(f"{name} of {records} pairs")
        known[f"{records} {name}"] = command_cost(records, name, arguments)
        write_results(results, {key: asdict(cost) for key, cost in known.items()}, build)
    return [known[key] for name in commands if (key := f"{records} {name}") in known]


def _commands(dataset: Path, made: Path) -> dict[str, list[str]]:
    """Arguments of `droguekit` by the name in the table; a command that writes a folder names it last."""
    recipe, here = str(dataset / RECIPE_FILE), str(dataset)
    return {
        "plan": ["plan", recipe, "--no-probe"],
        # All pairs are there: it checks their hashes, and writes manifest and annotations, which the next ones need.
        "render": ["render", recipe, "--workers", "1", "--out", here],
        "validate": ["validate", here],
        "coverage": ["coverage", here],
        "diff": ["diff", here, here],
        "coco": ["export", here, "--format", "coco", "--out", str(made / "coco")],
        "yolo": ["export", here, "--format", "yolo", "--out", str(made / "yolo")],
        "browse": ["browse", here, "--workers", "1", "--out", str(made / "page")],
    }


def table(costs: Sequence[CommandCost]) -> list[str]:
    """The costs as lines of Markdown."""
    rows = [
        f"| {cost.records:,} | `{cost.command}` | {cost.cpu_s:.1f} s | {cost.peak_mb:.0f} MB | {cost.wall_s:.1f} s |"
        for cost in costs
    ]
    return ["| records | command | CPU | most memory | by the clock |", "|---|---|---|---|---|", *rows]


def main() -> None:
    """Measure, and print all that is known."""
    parser = argparse.ArgumentParser(prog="python -m studies.scaling.large_dataset", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="for datasets and results")
    parser.add_argument("--records", type=int, default=10_000, help="pairs of the dataset")
    parser.add_argument("--command", action="append", default=[], help="only this one; may be repeated")
    parser.add_argument("--page", action="store_true", help="also open the page of `browse` in a browser")
    arguments = parser.parse_args()
    out, records = arguments.out, arguments.records
    with wrong_input_ends("large_dataset"):
        if records < PAIRS:
            raise ValueError(f"--records: must be at least {PAIRS}, got {records}")
        report = progress_report()
        dataset = build_dataset(out, records, PAIRS, report)
        print("\n".join(table(measure(dataset, records, arguments.command, report))))
        if arguments.page:
            print(page_cost(out / f"{records}-made" / "page" / "index.html", out / f"{records}-page.png"))


if __name__ == "__main__":
    main()
