"""Render frames on the workers of a Dask scheduler, which distributes them and survives lost workers and nodes."""

from __future__ import annotations

import logging
import math
import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

from datasets_manifest.storage.layout import EVENTS_FILE
from datasets_manifest.storage.manifest import cpu_features, software_versions
from datasets_manifest.storage.storage import absolute, open_storage
from droguekit.batch.execution import resident_gib
from droguekit.batch.frame_task import FrameReport, FrameTask, OtherBuildError
from droguekit.batch.stop_request import StopRequest
from droguekit.batch.worker_pool import MAX_ATTEMPTS, TaskAttempt, run_in_own_process
from render.device import Device
from render.engine import load_engine

if TYPE_CHECKING:
    from distributed import Client, Future

# Dask counts a failure for every frame that a lost worker held, though a node may be lost through no fault of theirs.
ALLOWED_FAILURES = 9
# Enough that no worker waits for the client, and few enough that the scheduler's memory is independent of the recipe.
_FRAMES_PER_WORKER = 2
_CONNECT_S = 30
# After its time a client takes a moment to say why it failed. [s]
_ANSWER_S = 5
# What stands in the queue of ended frames for a request to stop.
_STOP = -1
# Least time between two questions for the number of workers: the scheduler's answer is slower than a frame's report.
_WORKERS_EVERY_S = 1.0


class LostWorkersError(RuntimeError):
    """Dask gave up a frame because too many workers that held it were lost."""

    def __init__(self, was_alone: bool) -> None:
        """Take whether the workers held no other frame at the time."""
        lost, beside = (MAX_ATTEMPTS, "it alone") if was_alone else (ALLOWED_FAILURES + 1, "it and perhaps others")
        super().__init__(f"{lost} Dask workers died or ran out of time with {beside}")


@dataclass(frozen=True)
class WorkerBuild:
    """Software versions and processor features, on which pixels and labels depend besides the recipe."""

    software: tuple[tuple[str, str], ...]
    cpu_features: frozenset[str]


@cache
def current_build() -> WorkerBuild:
    """Versions and processor features of this process."""
    return WorkerBuild(tuple(sorted(software_versions().items())), frozenset(cpu_features()))


@dataclass(frozen=True)
class ClusterResult:
    """A frame made by a Dask worker.

    Attributes:
        report: time and size of the frame.
        worker: address of the worker.
        resident_gib: memory of the worker afterwards. [GiB]
    """

    report: FrameReport
    worker: str
    resident_gib: float


@dataclass(frozen=True)
class ClusterTask:
    """Makes a frame on a Dask worker, which must run the client's versions and see the same storage.

    Attributes:
        task: makes the frame.
        build: of the client.
        timeout_s: after which the worker's process ends; Dask starts another, which gets the frame again. [s]
    """

    task: FrameTask
    build: WorkerBuild
    timeout_s: float

    def __call__(self, frame_index: int) -> ClusterResult:
        """Make and write frame `frame_index`.

        Raises:
            OtherBuildError: packages or processor differ from the client's.
            OSError: the dataset's folder does not exist.
        """
        from distributed import get_worker

        worker = get_worker()
        where = f"Dask worker {worker.address}"
        _check_build(self.build, current_build(), where)
        if worker.state.nthreads != 1:
            raise OtherBuildError(
                f"{where}: must have one thread, has {worker.state.nthreads}; start with --nthreads 1"
            )
        if not open_storage(self.task.dataset).exists(EVENTS_FILE):
            raise FileNotFoundError(f"{where}: does not see {self.task.dataset}; give a folder on shared storage")
        # This signal ends the process by default, even where native code hangs.
        signal.setitimer(signal.ITIMER_REAL, self.timeout_s)
        try:
            report = self.task(frame_index)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        return ClusterResult(self.task.pack(frame_index, report), worker.address, resident_gib())


def make_on_worker(pickled_task: bytes, frame_index: int) -> ClusterResult:
    """Make frame `frame_index` by a pickled `ClusterTask`, which is pickled and unpickled once for all frames."""
    return _unpickled(pickled_task)(frame_index)


@lru_cache(maxsize=1)
def _unpickled(pickled_task: bytes) -> ClusterTask:
    task = pickle.loads(pickled_task)
    assert isinstance(task, ClusterTask)
    return task


def run_on_cluster(
    task: FrameTask, indices: Sequence[int], address: str, timeout_s: float, stop: StopRequest
) -> Generator[TaskAttempt[FrameReport], None, None]:
    """Make frames on the workers of a scheduler, and report each as it ends.

    Workers may join and leave meanwhile. The scheduler holds a few frames for each worker at any time.

    Args:
        task: makes a frame; its folder must be on storage that all workers share.
        indices: of the frames, each once.
        address: of the scheduler.
        timeout_s: for one frame. [s]
        stop: once it is requested, no more frames start, and the iterator ends after the running ones.

    Raises:
        ValueError: `distributed` is missing.
        OSError: no scheduler answers there, or it has ended.
    """
    version = task.engine_version or run_in_own_process(
        partial(_engine_version, task.recipe.render.engine, task.device)
    )
    shared = replace(task, dataset=absolute(task.dataset), engine_version=version)
    client = _connect(address, stop)
    if client is None:
        return
    try:
        window = _SubmissionWindow(client, ClusterTask(shared, current_build(), timeout_s), deque(indices), stop.say)
        yield from window.attempts(stop)
    finally:
        client.close()


class _SubmissionWindow:
    """Waiting frames, and the few frames that the scheduler holds."""

    def __init__(self, client: Client, task: ClusterTask, waiting: deque[int], say: Callable[[str], None]) -> None:
        self._client, self._task, self._waiting, self._say = client, pickle.dumps(task), waiting, say
        self._running: dict[int, Future] = {}
        # Frames that Dask gave up: one of them killed workers, the others may only have waited on the same workers.
        self._suspects: deque[int] = deque()
        self._alone = False
        # Futures end in a thread of Dask, and stop requests come from a signal handler: both only put into the queue.
        self._ended: SimpleQueue[int] = SimpleQueue()
        self._threads: dict[str, int] = {}
        self._is_told = False
        self._asked_s = -math.inf
        self._resident_gib: dict[str, float] = {}

    def attempts(self, stop: StopRequest) -> Generator[TaskAttempt[FrameReport], None, None]:
        """Report each frame as it ends; frames are cancelled when the caller stops iterating."""
        stop.wake = lambda: self._ended.put(_STOP)
        self._allow_failures(ALLOWED_FAILURES)
        try:
            while self._fill(stop.is_requested):
                index = self._next_ended()
                if index is None or index == _STOP:
                    if stop.is_requested and not self._has_workers():
                        return  # nobody makes the frames that are submitted
                    if index == _STOP:
                        stop.acknowledge(len(self._running))
                    continue
                future = self._running.pop(index)
                yield self._attempt(index, future)
                future.release()
        finally:
            self._client.cancel([*self._running.values()])

    def _fill(self, stopping: bool) -> bool:
        """Submit frames up to the window's size.

        Returns:
            Whether any frame is running.
        """
        size = self._size()
        while self._waiting and not stopping and len(self._running) < size:
            self._submit(self._waiting.popleft())
        if self._suspects and not self._running and not stopping:
            if not self._alone:
                self._alone = True
                self._allow_failures(MAX_ATTEMPTS - 1)
            self._submit(self._suspects.popleft())
        return bool(self._running)

    def _next_ended(self) -> int | None:
        """The frame that ended, `_STOP`, or None after a while in which neither came."""
        try:
            return self._ended.get(timeout=_WORKERS_EVERY_S)
        except Empty:
            if not self._has_workers() and not self._is_told:
                self._say("the Dask scheduler has no workers; waiting for some to join")
                self._is_told = True
            return None

    def _has_workers(self) -> bool:
        self._ask_for_workers()
        self._is_told = self._is_told and not self._threads
        return bool(self._threads)

    def _submit(self, index: int) -> None:
        future = self._client.submit(make_on_worker, self._task, index, pure=False)
        self._running[index] = future
        future.add_done_callback(partial(self._put, index))

    def _put(self, index: int, _: Any) -> None:
        self._ended.put(index)

    def _ask_for_workers(self) -> None:
        if time.monotonic() - self._asked_s > _WORKERS_EVERY_S:
            self._asked_s, self._threads = time.monotonic(), self._client.nthreads()
            self._resident_gib = {name: gib for name, gib in self._resident_gib.items() if name in self._threads}

    def _size(self) -> int:
        self._ask_for_workers()
        return _FRAMES_PER_WORKER * max(1, sum(self._threads.values()))

    def _allow_failures(self, count: int) -> None:
        self._client.run_on_scheduler(_allow_failures, count=count)

    def _attempt(self, index: int, future: Future) -> TaskAttempt[FrameReport]:
        """The outcome of a frame.

        Raises:
            OSError: the scheduler has ended.
        """
        from distributed import KilledWorker

        value: FrameReport | None = None
        error: Exception | None = None
        final = True
        try:
            made: ClusterResult = future.result()
            value, self._resident_gib[made.worker] = made.report, made.resident_gib
        except CancelledError as ended:
            raise OSError(
                "the Dask scheduler has ended; start it again, then run the same command to continue"
            ) from ended
        except KilledWorker:
            error, final = LostWorkersError(self._alone), self._alone
            if not final:
                self._suspects.append(index)
        except Exception as raised:
            error = raised
        return TaskAttempt(index, 1 + self._alone, value, error, final, sum(self._resident_gib.values()))


def _connect(address: str, stop: StopRequest) -> Client | None:
    """A client of the scheduler, or None where a stop is requested meanwhile.

    Raises:
        ValueError: `distributed` is missing.
        OSError: no scheduler answers.
    """
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise ValueError("--scheduler: Dask is missing: pip install 'droguekit[cluster]'") from error
    for name in ("distributed", "distributed.client"):  # Dask sets the level of the second separately
        logging.getLogger(name).setLevel(logging.CRITICAL)  # failures are reported by frame
    answers: SimpleQueue[Client | Exception | None] = SimpleQueue()

    def connect() -> None:
        try:
            # Every message to the scheduler names the task, and by default a client remembers the last thousand.
            with dask.config.set({"distributed.admin.low-level-log-length": 10}):
                answers.put(Client(address, timeout=_CONNECT_S, set_as_default=False))
        except Exception as error:
            answers.put(error)

    # Dask waits without a limit for the first words of whatever listens at the address.
    threading.Thread(target=connect, daemon=True).start()
    stop.wake = lambda: answers.put(None)
    try:
        answer = None if stop.is_requested else answers.get(timeout=_CONNECT_S + _ANSWER_S)
    except Empty:
        answer = OSError(f"what listens there said nothing for {_CONNECT_S} s")
    if isinstance(answer, Exception):
        raise OSError(f"--scheduler: no Dask scheduler answers at {address}: {answer}") from answer
    return answer


def _engine_version(name: str, device: Device) -> str:
    return load_engine(name, device).version


def _allow_failures(count: int, dask_scheduler: Any) -> None:
    dask_scheduler.allowed_failures = count


def _check_build(wanted: WorkerBuild, here: WorkerBuild, where: str) -> None:
    """Check that this worker makes the same frames as the client would.

    Raises:
        OtherBuildError: it does not; names what differs.
    """
    for name in sorted({name for name, _ in (*wanted.software, *here.software)}):
        there, mine = dict(wanted.software).get(name, "missing"), dict(here.software).get(name, "missing")
        if there != mine:
            raise OtherBuildError(f"{where}: has {name} {mine}, the client {there}; give both the same environment")
    odd = sorted(wanted.cpu_features ^ here.cpu_features)
    if odd:
        raise OtherBuildError(
            f"{where}: its processor differs from the client's in {', '.join(odd)}, so the last digits would differ; "
            "run the client on a node of the same kind"
        )
