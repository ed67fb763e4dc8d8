"""Measures speed-up and overhead of several workers: two against one, and the cost of a frame besides its rendering.

Run as `python -m studies.scaling --out out/scaling` on a machine that does nothing else. A stopped run
continues: results in `results.json` of that folder by the same code and machine are not measured again.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage.layout import EVENTS_FILE
from droguekit.batch.execution import ExecutionOptions, resident_gib
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.progress import ProgressReport, progress_report
from droguekit.batch.render_dataset import EventLog, make_frames
from studies.stored_figures import RENDER_COMMAND, read_results, rendering_build, write_results
from studies.wrong_input import wrong_input_ends

EMPTY_RECIPE = """
name = "empty"
seed = 1
rig = "rgb-ideal"
[frames]
count = {count}
scenes = 1
[distance]
law = "uniform"
low_m = 2.0
high_m = 40.0
[render]
engine = "analytic"
"""
_SAMPLES = 5
_START_S = 120.0


@dataclass(frozen=True)
class EmptyFrameTask(FrameTask):
    """Goes through recipe, processes and reports like a frame, but renders nothing."""

    def __call__(self, frame_index: int) -> FrameReport:
        """The report of a frame that took no time."""
        return FrameReport(socket.gethostname(), 0.0, {}, None, 0)


@dataclass
class MemorySamples:
    """Forwards progress reports, and samples the memory of this process.

    Attributes:
        shown: the report that everything is forwarded to.
        every: frames between two samples.
        client_mib: resident memory by the number of finished frames. [MiB]
    """

    shown: ProgressReport
    every: int
    client_mib: dict[int, float] = field(default_factory=dict)
    _done: int = 0

    def begin(self, what: str, total: int) -> None:
        """Pass it on."""
        self.shown.begin(what, total)

    def advance(self) -> None:
        """Count it, and sample the memory at intervals."""
        self._done += 1
        if self._done % self.every == 0:
            self.client_mib[self._done] = round(resident_gib() * 1024, 1)
        self.shown.advance()

    def note(self, text: str) -> None:
        """Pass it on."""
        self.shown.note(text)

    def say(self, text: str) -> None:
        """Pass it on."""
        self.shown.say(text)

    def end(self) -> None:
        """Pass it on."""
        self.shown.end()


def local_cost(folder: Path, frames: int, workers: int, report: ProgressReport) -> dict[str, Any]:
    """CPU time and wall time a frame, and the parent's memory, with worker processes of this machine.

    Args:
        folder: to work in; emptied first.
        frames: how many.
        workers: how many processes.
        report: of progress.

    Returns:
        `cpu_ms` of the client and of the workers a frame, their start and replacement included, `wall_ms` a frame,
        and `client_mib` by the number of finished frames.

    Raises:
        OSError: processes cannot be started.
    """
    before_s = children_cpu_s()
    cost = _run(folder, frames, ExecutionOptions(workers), report)
    cost["cpu_ms"]["workers"] = 1000 * (children_cpu_s() - before_s) / frames
    return cost


def dask_cost(folder: Path, frames: int, workers: int, report: ProgressReport) -> dict[str, Any]:
    """The same with the workers of a Dask scheduler on loopback, without the start of these processes.

    Args:
        folder: to work in; emptied first.
        frames: how many.
        workers: how many processes.
        report: of progress.

    Returns:
        As `local_cost`, with the scheduler beside client and workers.

    Raises:
        OSError: the scheduler or a worker does not start.
    """
    with _dask(workers) as (address, scheduler, crew):
        before_s = _cpu_s(scheduler), sum(map(_cpu_s, crew))
        cost = _run(folder, frames, ExecutionOptions(0, scheduler=address), report)
        after_s = _cpu_s(scheduler), sum(map(_cpu_s, crew))
    for name, before, after in zip(("scheduler", "workers"), before_s, after_s, strict=True):
        cost["cpu_ms"][name] = 1000 * (after - before) / frames
    return cost


def children_cpu_s() -> float:
    """User and system time of the processes that this one has started and waited for, and of theirs. [s]"""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _run(folder: Path, frames: int, options: ExecutionOptions, report: ProgressReport) -> dict[str, Any]:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    task = EmptyFrameTask(parse_recipe(EMPTY_RECIPE.format(count=frames)), folder)
    samples = MemorySamples(report, max(1, frames // _SAMPLES))
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    with (folder / EVENTS_FILE).open("a", encoding="utf-8") as stream:
        make_frames(task, range(frames), options, samples, EventLog(stream))
    cpu_ms = {"client": 1000 * (time.process_time() - began_cpu_s) / frames}
    wall_ms = 1000 * (time.monotonic() - began_s) / frames
    return {"cpu_ms": cpu_ms, "wall_ms": wall_ms, "client_mib": samples.client_mib}


@contextmanager
def _dask(workers: int) -> Iterator[tuple[str, int, list[int]]]:
    """A scheduler with workers: its address, its process and theirs."""
    processes: list[subprocess.Popen[bytes]] = []

    def start(kind: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments, "--no-dashboard"]
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        processes.append(process)

    with TemporaryDirectory(prefix="droguekit-") as scratch:
        file = Path(scratch) / "scheduler.json"
        try:
            start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
            _await(lambda: file.exists() and file.read_text(encoding="utf-8").endswith("}"))
            address = str(json.loads(file.read_text(encoding="utf-8"))["address"])
            for _ in range(workers):
                start("worker", address, "--nthreads", "1", "--no-nanny", "--local-directory", scratch)
            from distributed import Client

            with Client(address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=_START_S)
            yield address, processes[0].pid, [process.pid for process in processes[1:]]
        finally:
            for process in processes:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _await(happened: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + _START_S
    while not happened():
        if time.monotonic() > deadline_s:
            raise OSError("the Dask scheduler does not start")
        time.sleep(0.05)


def _cpu_s(process: int) -> float:
    """User and system time of a process. [s] proc(5), fields 14 and 15 of `stat`."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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
        All results of this code and machine in the folder by their names; others are left out.

    Raises:
        ValueError: the results in the folder are damaged; names the file.
        OSError: a process failed, or the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    build = rendering_build((*RENDER_COMMAND, "studies.scaling"))
    known = read_results(out / RESULTS_FILE, build, report)
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
        write_results(out / RESULTS_FILE, known, build)
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
        with wrong_input_ends("scaling"):
            if arguments.pairs < 1 or arguments.frames < 1:
                raise ValueError("--pairs, --frames: must be at least 1")
            wanted = tuple(arguments.part or parts)
            results = measure(arguments.out, arguments.pairs, arguments.frames, wanted, progress_report())
    except KeyboardInterrupt:
        print("scaling: interrupted; the same command continues from the finished results", file=sys.stderr)
        return 130
    print("\n".join(table(results)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
