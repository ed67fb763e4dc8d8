"""Worker processes: what a crash and an error cost, and that no process outlives the run."""

from __future__ import annotations

import os
import platform
import select
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest

from droguekit.batch.execution import available_cores, available_memory_gib, default_workers
from droguekit.batch.worker_pool import (
    MAX_ATTEMPTS,
    READY,
    UNTIMED,
    TaskTimeoutError,
    Worker,
    WorkerDiedError,
    WorkerLimits,
    run_in_own_process,
    run_tasks,
)

# Workers are fresh processes: what they run must be importable there, which a test module is not.
TASKS = """
import ctypes, os, signal, threading
from pathlib import Path

def square(index):
    return index * index

def die_once(folder, victim, index):
    mark = Path(folder) / str(index)
    if index == victim and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return index * index

def die_always(victim, index):
    if index == victim:
        os.kill(os.getpid(), signal.SIGKILL)
    return index * index

def refuse(victim, index):
    if index == victim:
        raise ValueError(f"index: {index} is refused")
    return index * index

def threads():
    return [os.environ[name] for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")]

def process_of(index):
    return os.getpid()

def grow(index):
    held.append(bytearray(2**20))
    held[-1][::4096] = bytes([1]) * len(held[-1][::4096])
    return os.getpid()

held = []

def add(amount, index, value):
    return value + amount

def refuse_after(index, value):
    raise ValueError(f"{value} is refused")

def hang(index):
    # A C function that holds Python's lock: no signal handler and no thread of this process ever runs again.
    ctypes.PyDLL(None).pause()

def raise_odd_error(index):
    raise OddError(1, 2)

class OddError(Exception):
    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")

def die_with_a_folder(index):
    from datasets_manifest.atomic import scratch_folder
    with scratch_folder() as folder:
        (folder / "mesh.ply").write_text("mesh")
        os.kill(os.getpid(), signal.SIGKILL)

def talk(index):
    print(f"standard output {index}")
    os.write(2, b"x" * 5000 + f" LLVM says {index}".encode())
    if index == 1:
        os.write(2, b", and dies")
        os.kill(os.getpid(), signal.SIGABRT)

def siblings(index):
    parent = os.getppid()
    return len(Path(f"/proc/{parent}/task/{parent}/children").read_text().split())

def tell_and_wait(pipe, index):
    with open(pipe, "w") as stream:
        stream.write(f"{os.getpid()}\\n")
    threading.Event().wait()
"""


@pytest.fixture
def tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    (tmp_path / "worker_tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "worker_tasks", raising=False)
    import worker_tasks

    return worker_tasks


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_every_task_is_done_once_whatever_the_number_of_workers(tasks: ModuleType, workers: int) -> None:
    attempts = [*run_tasks(tasks.square, range(5), workers)]
    assert sorted((attempt.index, attempt.value) for attempt in attempts) == [(i, i * i) for i in range(5)]
    assert all(attempt.final and attempt.number == 1 and attempt.error is None for attempt in attempts)


def test_a_killed_worker_costs_one_attempt_of_one_task(tasks: ModuleType, tmp_path: Path) -> None:
    attempts = [*run_tasks(partial(tasks.die_once, str(tmp_path), 2), range(5), 2)]
    failed = [attempt for attempt in attempts if attempt.error is not None]
    assert [(attempt.index, attempt.number, attempt.final) for attempt in failed] == [(2, 1, False)]
    assert isinstance(failed[0].error, WorkerDiedError)
    assert {attempt.index: attempt.value for attempt in attempts if attempt.final} == {i: i * i for i in range(5)}
    assert next(attempt.number for attempt in attempts if attempt.index == 2 and attempt.final) == 2


def test_a_task_that_always_kills_its_worker_is_given_up_and_the_others_are_done(tasks: ModuleType) -> None:
    attempts = [*run_tasks(partial(tasks.die_always, 1), range(3), 1)]
    deaths = [attempt for attempt in attempts if attempt.index == 1]
    assert [attempt.number for attempt in deaths] == list(range(1, MAX_ATTEMPTS + 1))
    assert [attempt.final for attempt in deaths] == [False] * (MAX_ATTEMPTS - 1) + [True]
    assert {attempt.index: attempt.value for attempt in attempts if attempt.final} == {0: 0, 1: None, 2: 4}


def test_what_a_worker_writes_is_kept_for_the_log(tasks: ModuleType, capfd: pytest.CaptureFixture[str]) -> None:
    attempts = [*run_tasks(tasks.talk, range(3), 1)]
    told = {(attempt.index, attempt.number): attempt.output for attempt in attempts}
    # The end of it, and of each attempt its own.
    assert {key: text.lstrip("x") for key, text in told.items()} == {
        (0, 1): " LLVM says 0",
        (2, 1): " LLVM says 2",
        **{(1, number): " LLVM says 1, and dies" for number in (1, 2, 3)},
    }
    assert all(len(text) <= 4000 and "standard output" not in text for text in told.values())
    assert capfd.readouterr() == ("", "")


def test_one_worker_may_go_first(tasks: ModuleType) -> None:
    """It fills a cache that the others then read."""
    limits = WorkerLimits(is_first_alone=True)
    attempts = {attempt.index: attempt.value for attempt in run_tasks(tasks.siblings, range(4), 3, limits)}
    before = len(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split())
    assert attempts[0] == before + 1
    assert sorted(attempts) == [0, 1, 2, 3]
    # A first task that fails for good does not hold up the others.
    values = {each.index: each.value for each in run_tasks(partial(tasks.refuse, 0), range(4), 3, limits)}
    assert values == {0: None, 1: 1, 2: 4, 3: 9}


def test_a_killed_worker_leaves_no_temporary_folder(
    tasks: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setenv("TMPDIR", str(scratch))
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    (scratch / f"droguekit-{os.getpid()}-mine").mkdir()
    attempts = [*run_tasks(tasks.die_with_a_folder, [0], workers=1)]
    assert len(attempts) == MAX_ATTEMPTS
    assert [path.name for path in scratch.iterdir()] == [f"droguekit-{os.getpid()}-mine"]


@pytest.mark.parametrize("workers", [0, 1])
def test_an_error_is_reported_and_not_tried_again(tasks: ModuleType, workers: int) -> None:
    attempts = [*run_tasks(partial(tasks.refuse, 1), range(3), workers)]
    assert len(attempts) == 3
    error = next(attempt.error for attempt in attempts if attempt.index == 1)
    assert isinstance(error, ValueError)
    assert str(error) == "index: 1 is refused"


@pytest.mark.parametrize("workers", [0, 1])
def test_what_follows_on_a_task_makes_its_value_and_its_error(tasks: ModuleType, workers: int) -> None:
    attempts = [*run_tasks(tasks.square, range(3), workers, then=partial(tasks.add, 10))]
    assert {attempt.index: attempt.value for attempt in attempts} == {0: 10, 1: 11, 2: 14}
    (attempt,) = run_tasks(tasks.square, [2], workers, then=tasks.refuse_after)
    assert attempt.value is None and str(attempt.error) == "4 is refused" and attempt.final


def test_the_time_of_a_task_ends_before_what_follows_on_it(tasks: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    worker = Worker(tasks.square, partial(tasks.add, 10))
    try:
        assert worker.receive() == READY
        worker.assign(3)
        assert worker.receive() == UNTIMED
        assert worker.receive()[0] == 19
    finally:
        worker.kill()
    # As if the time were over as soon as the task is.
    monkeypatch.setattr(Worker, "seconds_left", lambda worker, timeout_s: timeout_s if worker.is_timed else -1.0)
    attempts = [*run_tasks(tasks.square, range(4), 2, WorkerLimits(timeout_s=600.0), then=partial(tasks.add, 10))]
    assert sorted(attempt.value or 0 for attempt in attempts) == [10, 11, 14, 19]


def test_workers_get_one_thread_each_and_this_process_keeps_its_own(
    tasks: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert run_in_own_process(tasks.threads) == ["1", "1", "1"]
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_function_that_runs_alone_raises_here_what_it_raised_there(tasks: ModuleType) -> None:
    with pytest.raises(ValueError, match="index: 3 is refused"):
        run_in_own_process(partial(tasks.refuse, 3, 3))


def test_workers_end_with_the_process_that_started_them(tasks: ModuleType, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from functools import partial\n"
        "import worker_tasks\n"
        "from droguekit.batch.worker_pool import run_tasks\n"
        "if __name__ == '__main__':\n"
        f"    list(run_tasks(partial(worker_tasks.tell_and_wait, {str(pipe)!r}), [0], 1))\n"
    )
    main = tmp_path / "main.py"
    main.write_text(script)
    with subprocess.Popen([sys.executable, str(main)], stderr=subprocess.DEVNULL) as parent:
        with pipe.open() as stream:
            worker = os.pidfd_open(int(stream.readline()))
        parent.kill()
        parent.wait()
    ended, _, _ = select.select([worker], [], [], 60)  # a process handle is readable once the process has ended
    os.close(worker)
    assert ended


def test_a_task_that_hangs_is_stopped_and_given_up(tasks: ModuleType) -> None:
    attempts = [*run_tasks(tasks.hang, [4], 1, WorkerLimits(timeout_s=0.5))]
    assert [(attempt.number, attempt.final) for attempt in attempts] == [(1, False), (2, False), (3, True)]
    assert all(isinstance(attempt.error, TaskTimeoutError) for attempt in attempts)


def test_a_process_is_replaced_after_its_number_of_tasks(tasks: ModuleType) -> None:
    processes = [
        attempt.value for attempt in run_tasks(tasks.process_of, range(5), 1, WorkerLimits(tasks_per_process=2))
    ]
    assert len(set(processes)) == 3
    assert processes[0] == processes[1]
    assert processes[2] == processes[3]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no malloc_trim")
def test_memory_between_live_objects_goes_back_to_the_kernel() -> None:
    script = """
from droguekit.batch.execution import resident_gib, return_free_memory
freed, kept = zip(*((bytearray(60_000), bytearray(1_000)) for _ in range(4_000)))
del freed
before_gib = resident_gib()
return_free_memory()
print(before_gib - resident_gib())
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    # Of 240 MB each piece loses up to a page at either end.
    assert float(ran.stdout) > 0.15


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no malloc_trim")
def test_memory_of_objects_that_refer_to_themselves_goes_back_to_the_kernel() -> None:
    script = """
import gc
from droguekit.batch.execution import resident_gib, return_free_memory
gc.disable()
for _ in range(1_000):
    circle = [bytearray(200_000)]
    circle.append(circle)
before_gib = resident_gib()
return_free_memory()
print(before_gib - resident_gib())
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert float(ran.stdout) > 0.15


def test_a_process_is_replaced_when_it_holds_too_much_memory(tasks: ModuleType) -> None:
    # No Python process is as small as the first limit, and none here as large as the second.
    for limit_gib, processes in ((1e-6, 4), (100.0, 1)):
        made = [attempt.value for attempt in run_tasks(tasks.grow, range(4), 1, WorkerLimits(process_gib=limit_gib))]
        assert len(set(made)) == processes


def test_an_error_that_cannot_cross_processes_says_the_same(tasks: ModuleType) -> None:
    with pytest.raises(ValueError, match="OddError: 1 and 2") as caught:
        run_in_own_process(partial(tasks.raise_odd_error, 0))
    assert "raise OddError(1, 2)" in "".join(caught.value.__notes__)


def test_workers_that_cannot_start_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_tasks.py").write_text(
        "import os, sys\nif '--multiprocessing-fork' in sys.orig_argv: os._exit(3)\ndef task(load, index): return 0\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    import broken_tasks  # type: ignore[import-not-found]

    # More than a pipe holds: a dead process never takes it.
    load = bytes(2**20)
    with pytest.raises(OSError, match=r"end before their first task; the last: .*exit code 3"):
        list(run_tasks(partial(broken_tasks.task, load), range(100), 2))


def test_a_script_without_a_main_guard_ends_with_an_error(tmp_path: Path) -> None:
    """Its worker processes run it again, and end before they take their function."""
    script = tmp_path / "script.py"
    script.write_text(
        "from functools import partial\n"
        "from operator import getitem\n"
        "from droguekit.batch.worker_pool import run_tasks\n"
        "list(run_tasks(partial(getitem, bytes(2**20)), range(4), 1))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "OSError: worker processes end before their first task" in done.stderr


@pytest.mark.parametrize("wrong", [{"timeout_s": 0}, {"tasks_per_process": 0}, {"process_gib": -1.0}])
def test_limits_must_be_positive(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: must be above 0"):
        WorkerLimits(**wrong)  # type: ignore[arg-type]


def test_a_containers_share_counts(tmp_path: Path) -> None:
    free_gib, cores = available_memory_gib(tmp_path), available_cores(tmp_path)
    (tmp_path / "cpu.max").write_text("100000 100000\n")
    (tmp_path / "memory.max").write_text(f"{3 * 2**20}\n")
    (tmp_path / "memory.current").write_text(f"{2 * 2**20}\n")
    (tmp_path / "memory.stat").write_text(f"anon 5\ninactive_file {2**20}\n")
    assert available_cores(tmp_path) == 1
    assert available_memory_gib(tmp_path) == 2 / 1024
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert available_cores(tmp_path) == cores
    # Other processes take and give memory meanwhile; a limit of MiB would show.
    assert available_memory_gib(tmp_path) > min(1.0, free_gib / 2)


def test_there_is_always_a_worker() -> None:
    assert 1 <= default_workers() <= len(os.sched_getaffinity(0))
