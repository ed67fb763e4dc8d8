"""Overhead of a frame, measured with frames that need no work."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage.layout import EVENTS_FILE
from droguekit.batch.execution import ExecutionOptions, resident_gib
from droguekit.batch.frame_task import FrameReport, FrameTask
from droguekit.batch.progress import ProgressReport
from droguekit.batch.render_dataset import EventLog, make_frames

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
