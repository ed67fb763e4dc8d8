"""A real Dask scheduler with workers as processes on loopback: lost and late workers change nothing."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage import layout
from droguekit.batch import cluster
from droguekit.batch.cluster import ClusterTask, WorkerBuild, current_build
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.frame_task import FrameTask, OtherBuildError
from droguekit.batch.render_dataset import render_dataset
from droguekit.batch.stop_request import StopRequest
from droguekit.cli.main import WRONG_INPUT, run
from render.engine import EngineUnavailableError
from tests.support.batch_datasets import ANALYTIC_RECIPE, QUICK_RECIPE, file_hashes, render_recipe

distributed = pytest.importorskip("distributed", reason="Dask is missing: pip install 'droguekit[cluster]'")

Start = Callable[..., subprocess.Popen[bytes]]
Troubled = Callable[..., Path]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts Dask processes, `start("scheduler", ...)`, and ends them with the test."""
    processes: list[subprocess.Popen[bytes]] = []

    def launch(*arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]]
        with (tmp_path / "dask.log").open("ab") as log:
            processes.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path, start_new_session=True))
        return processes[-1]

    yield launch
    for process in processes:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.fixture
def scheduler(start: Start, tmp_path: Path) -> str:
    """Address of a scheduler on loopback."""
    file = tmp_path / "scheduler.json"
    process = start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    while not file.exists() or not file.read_text().endswith("}"):
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.05)
    return str(json.loads(file.read_text())["address"])


def worker(start: Start, address: str, nanny: str = "--no-nanny") -> subprocess.Popen[bytes]:
    return start("worker", address, "--nthreads", "1", "--no-dashboard", nanny)


class OnFrame:
    """A progress report that runs an action once a number of frames is finished."""

    def __init__(self, number: int, action: Callable[[], object]) -> None:
        self._left, self._action = number, action
        self.told: list[str] = []
        self.on_line: Callable[[str], object] = lambda text: None

    def begin(self, what: str, total: int) -> None:
        """Nothing to do."""

    def advance(self) -> None:
        self._left -= 1
        if self._left == 0:
            self._action()

    def note(self, text: str) -> None:
        """Nothing to do."""

    def say(self, text: str) -> None:
        self.told.append(text)
        self.on_line(text)

    def end(self) -> None:
        """Nothing to do."""


def test_a_worker_that_is_killed_and_one_that_comes_later_change_nothing(
    start: Start, scheduler: str, tmp_path: Path
) -> None:
    text = ANALYTIC_RECIPE.replace("count = 8", "count = 12")
    render_recipe(tmp_path / "calm", workers=0, text=text)
    workers = [worker(start, scheduler) for _ in range(2)]

    def change_the_crew() -> None:
        workers[0].kill()
        worker(start, scheduler)

    report = OnFrame(3, change_the_crew)
    out = tmp_path / "out"
    summary = render_dataset(
        RecipeSource(parse_recipe(text), text), out, range(12), ExecutionOptions(0, scheduler=scheduler), report
    )
    assert summary.drops == ()
    assert file_hashes(out) == file_hashes(tmp_path / "calm")
    lines = [json.loads(line) for line in (out / layout.EVENTS_FILE).read_text().splitlines()]
    frames = [line for line in lines if line["event"] == "frame"]
    assert sorted(line["frame"] for line in frames) == [*range(12)]
    assert all(line["workers_gib"] > 0 for line in frames)


def test_a_request_to_stop_finishes_the_frames_in_hand(start: Start, scheduler: str, tmp_path: Path) -> None:
    text = ANALYTIC_RECIPE.replace("count = 8", "count = 12")
    worker(start, scheduler)
    report = OnFrame(2, lambda: os.kill(os.getpid(), signal.SIGINT))
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        render_dataset(
            RecipeSource(parse_recipe(text), text), out, range(12), ExecutionOptions(0, scheduler=scheduler), report
        )
    made = len(layout.frame_indices(out))
    # Two were finished, and at most two more were with the one worker.
    assert 2 <= made <= 4
    assert report.told[-1] == f"stopped after {made} of 12 pairs, all of them complete"


def render_on(address: str, out: Path, report: OnFrame) -> None:
    source = RecipeSource(parse_recipe(ANALYTIC_RECIPE), ANALYTIC_RECIPE)
    render_dataset(source, out, range(8), ExecutionOptions(0, scheduler=address), report)


def test_a_run_without_workers_says_so_and_stops_at_once(scheduler: str, tmp_path: Path) -> None:
    report = OnFrame(0, lambda: None)
    report.on_line = lambda text: os.kill(os.getpid(), signal.SIGTERM) if "waiting" in text else None
    with pytest.raises(KeyboardInterrupt):
        render_on(scheduler, tmp_path / "out", report)
    assert report.told == [
        "the Dask scheduler has no workers; waiting for some to join",
        "stopped after 0 of 8 pairs, all of them complete",
    ]


@pytest.fixture
def silence() -> Iterator[socket.socket]:
    """A program that accepts connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener


def test_a_port_where_something_else_listens_is_given_up(
    silence: socket.socket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.5)
    address = f"tcp://127.0.0.1:{silence.getsockname()[1]}"
    with pytest.raises(OSError, match=rf"--scheduler: no Dask scheduler answers at {address}: what listens there said"):
        render_on(address, tmp_path / "out", OnFrame(0, lambda: None))
    assert not (tmp_path / "out").exists()


def test_a_port_where_nothing_listens_is_said_to_refuse(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_CONNECT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as closed:
        address = f"tcp://127.0.0.1:{closed.getsockname()[1]}"
    with pytest.raises(OSError, match=rf"--scheduler: no Dask scheduler answers at {address}: (?!what listens)"):
        render_on(address, tmp_path / "out", OnFrame(0, lambda: None))


def test_a_request_to_stop_ends_the_wait_for_the_scheduler(silence: socket.socket, tmp_path: Path) -> None:
    def stop_when_it_connects() -> None:
        with silence.accept()[0]:
            os.kill(os.getpid(), signal.SIGTERM)
            ended.wait()

    ended = threading.Event()
    thread = threading.Thread(target=stop_when_it_connects)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        render_on(f"tcp://127.0.0.1:{silence.getsockname()[1]}", tmp_path / "out", OnFrame(0, lambda: None))
    ended.set()
    thread.join()


@pytest.mark.slow  # Dask starts the worker anew four times
def test_a_frame_that_ends_every_worker_takes_none_with_it(
    start: Start,
    scheduler: str,
    troubled: Troubled,
    quick_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    troubled(abort=[2])
    # Dask blames the frame behind it on the one worker as well; one death each is enough for that here.
    monkeypatch.setattr(cluster, "ALLOWED_FAILURES", 0)
    worker(start, scheduler, "--nanny")
    out, told = tmp_path / "out", io.StringIO()
    summary = render_recipe(out, [1, 2, 3, 4], ExecutionOptions(0, scheduler=scheduler), QUICK_RECIPE, told)
    reason = "3 Dask workers died or ran out of time with it alone"
    assert [(drop.frame_index, drop.reason) for drop in summary.drops] == [(2, reason)], told.getvalue()
    assert sorted(summary.totals.made) == [1, 3, 4]
    assert summary.totals.retries >= 1
    for frame_index in (1, 3, 4):
        made, calm = (layout.frame_folder(dataset, frame_index) for dataset in (out, quick_dataset))
        assert file_hashes(made) == file_hashes(calm)


@pytest.mark.slow  # for as long as the time that the frame is given
def test_a_frame_that_hangs_ends_its_worker_and_is_made_by_the_next(
    start: Start,
    scheduler: str,
    troubled: Troubled,
    quick_dataset: Path,
    tmp_path: Path,
) -> None:
    marks = troubled(hang_once=[1])
    worker(start, scheduler, "--nanny")
    out = tmp_path / "out"
    # The frame takes about 50 ms; where a crowded machine gives all its attempts too little time, it is made later.
    summary = render_recipe(out, [1], ExecutionOptions(0, timeout_s=60.0, scheduler=scheduler), QUICK_RECIPE)
    assert (marks / "hang-1").exists()
    assert summary.totals.made == [1] or [drop.frame_index for drop in summary.drops] == [1]
    assert render_recipe(out, [1], text=QUICK_RECIPE).pairs == 1
    assert file_hashes(layout.frame_folder(out, 1)) == file_hashes(layout.frame_folder(quick_dataset, 1))


@pytest.mark.slow
def test_slurm_jobs_that_dask_jobqueue_submits_make_the_dataset(
    start: Start,
    analytic_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    interrupt = signal.getsignal(signal.SIGINT)
    jobqueue = pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is missing: pip install 'droguekit[cluster]'")
    signal.signal(signal.SIGINT, interrupt)  # its import takes over Ctrl-C of this process, and so of all later tests
    # What SLURM does with a job, on this machine: runs its script, tells its number, and ends it when told.
    programs = tmp_path / "bin"
    programs.mkdir()
    for name, script in {
        "sbatch": 'cp "$1" "$JOBS/script-$$" && setsid sh "$JOBS/script-$$" >"$JOBS/log-$$" 2>&1 &\n'
        'echo $! >>"$JOBS/started"\necho "Submitted batch job $!"\n',
        "scancel": 'kill -9 -"$1"\n',
    }.items():
        (programs / name).write_text("#!/bin/sh\n" + script)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setenv("JOBS", str(tmp_path))
    with jobqueue.SLURMCluster(
        cores=1,
        processes=1,
        memory="2GB",
        interface="lo",
        nanny=False,
        log_directory=str(tmp_path),
        worker_extra_args=["--no-dashboard"],
        scheduler_options={"dashboard": False, "dashboard_address": ":0"},
    ) as cluster:
        cluster.scale(jobs=1)
        summary = render_recipe(
            tmp_path / "out", workers=ExecutionOptions(0, scheduler=cluster.scheduler_address), text=ANALYTIC_RECIPE
        )
    assert len((tmp_path / "started").read_text().split()) >= 1
    assert summary.drops == ()
    assert file_hashes(tmp_path / "out") == file_hashes(analytic_dataset)


def test_workers_of_another_build_are_refused(start: Start, scheduler: str, tmp_path: Path) -> None:
    worker(start, scheduler)
    here = current_build()
    builds = {
        "has numpy .*, the client 0.9": WorkerBuild((*here.software, ("numpy", "0.9")), here.cpu_features),
        "processor differs from the client's in AVX4096": WorkerBuild(here.software, here.cpu_features | {"AVX4096"}),
    }
    (tmp_path / layout.EVENTS_FILE).touch()
    with distributed.Client(scheduler, set_as_default=False) as client:
        for message, build in builds.items():
            task = FrameTask(parse_recipe(ANALYTIC_RECIPE), tmp_path)
            with pytest.raises(OtherBuildError, match=message):
                client.submit(ClusterTask(task, build, 600.0), 0, pure=False).result()
        lost = ClusterTask(FrameTask(parse_recipe(ANALYTIC_RECIPE), tmp_path / "elsewhere"), here, 600.0)
        with pytest.raises(FileNotFoundError, match=r"does not see .*elsewhere; give a folder on shared storage"):
            client.submit(lost, 0, pure=False).result()
        late = ClusterTask(FrameTask(parse_recipe(ANALYTIC_RECIPE), tmp_path, "analytic 0.1"), here, 600.0)
        with pytest.raises(OtherBuildError, match=r"made by analytic 0\.1, but this is"):
            client.submit(late, 0, pure=False).result()


def test_workers_and_scheduler_exclude_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"]
    assert run(["render", "smoke", "--engine", "analytic", "--out", str(tmp_path / "out"), *options]) == WRONG_INPUT
    assert "--workers: are processes of this machine" in capsys.readouterr().err


def test_a_device_that_is_missing_here_is_told_before_workers_are_asked(tmp_path: Path) -> None:
    task = FrameTask(parse_recipe(ANALYTIC_RECIPE), tmp_path, device="cuda")
    with StopRequest(print) as stop, pytest.raises(EngineUnavailableError, match=r"^device cuda: engine analytic"):
        next(cluster.run_on_cluster(task, [0], "tcp://127.0.0.1:9", 600.0, stop))
