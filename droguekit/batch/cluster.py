"""Frames made by the workers of a Dask scheduler, which spreads them, restarts what dies and survives lost nodes."""

from __future__ import annotations

import logging
import math
import pickle
import signal
import time
from collections import deque
from collections.abc import Generator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from datasets_manifest.storage.layout import EVENTS_FILE
from datasets_manifest.storage.provenance import cpu_features, software_versions
from datasets_manifest.storage.storage import absolute, open_storage
from droguekit.batch.execution import resident_gib
from droguekit.batch.frame_task import FrameReport, FrameTask, OtherBuildError
from droguekit.batch.stop_request import StopRequest
from droguekit.batch.worker_pool import MAX_ATTEMPTS, TaskAttempt, run_in_own_process
from render.engine import load_engine

if TYPE_CHECKING:
    from distributed import Client, Future

# Nodes that are taken away are no fault of the frames on them, and Dask blames every frame that a lost worker held.
ALLOWED_FAILURES = 9
# Enough that no worker waits for the client, and few enough that the scheduler stays small whatever the recipe's size.
_FRAMES_PER_WORKER = 2
_CONNECT_S = 30
# The crew is asked for this often at most: the answer comes from the scheduler, and takes longer than a frame's report.
_CREW_EVERY_S = 1.0


class LostWorkersError(RuntimeError):
    """Dask gave a frame up because too many workers were lost that held it."""

    def __init__(self, was_alone: bool) -> None:
        """With whether nothing else was with the workers at the time."""
        lost, beside = (MAX_ATTEMPTS, "it alone") if was_alone else (ALLOWED_FAILURES + 1, "it and perhaps others")
        super().__init__(f"{lost} Dask workers died or ran out of time with {beside}")


@dataclass(frozen=True)
class WorkerBuild:
    """What pixels and labels depend on besides the recipe."""

    software: tuple[tuple[str, str], ...]
    cpu_features: frozenset[str]


@cache
def current_build() -> WorkerBuild:
    """The build of this process."""
    return WorkerBuild(tuple(sorted(software_versions().items())), frozenset(cpu_features()))


@dataclass(frozen=True)
class ClusterResult:
    """A frame that a Dask worker has made.

    Attributes:
        report: what it cost.
        worker: address of the worker.
        resident_gib: memory that the worker held afterwards. [GiB]
    """

    report: FrameReport
    worker: str
    resident_gib: float


@dataclass(frozen=True)
class ClusterTask:
    """A frame on a Dask worker, which must be of the same build as the client and see the same storage.

    Attributes:
        task: makes the frame.
        build: of the client.
        timeout_s: after which the worker's process ends; Dask starts another and gives it the frame again. [s]
    """

    task: FrameTask
    build: WorkerBuild
    timeout_s: float

    def __call__(self, frame_index: int) -> ClusterResult:
        """Make and write frame `frame_index`.

        Raises:
            OtherBuildError: other packages or another processor than the client's.
            OSError: the dataset's folder is not there.
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
        # The kernel's default for this signal ends the process, whatever hangs in it, by a clock that nobody sets.
        signal.setitimer(signal.ITIMER_REAL, self.timeout_s)
        try:
            report = self.task(frame_index)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        return ClusterResult(self.task.pack(frame_index, report), worker.address, resident_gib())


def make_on_worker(pickled_task: bytes, frame_index: int) -> ClusterResult:
    """Frame `frame_index` by a pickled `ClusterTask`; for thousands of frames it is packed and unpacked once."""
    return _unpickled(pickled_task)(frame_index)


@lru_cache(maxsize=1)
def _unpickled(pickled_task: bytes) -> ClusterTask:
    task = pickle.loads(pickled_task)
    assert isinstance(task, ClusterTask)
    return task


def run_on_cluster(
    task: FrameTask, indices: Sequence[int], address: str, timeout_s: float, stop: StopRequest
) -> Generator[TaskAttempt[FrameReport], None, None]:
    """Let the workers of a scheduler make frames, and report each as it ends.

    Workers may come and go meanwhile. A few frames for each worker are with the scheduler at any time.

    Args:
        task: makes a frame; its folder must be on storage that all workers share.
        indices: of the frames, without repetition.
        address: of the scheduler.
        timeout_s: for one frame. [s]
        stop: once it is requested, no more frames begin, and the iterator ends with those that are running.

    Raises:
        ValueError: `distributed` is missing.
        OSError: no scheduler answers there, or it has ended.
    """
    version = task.engine_version or run_in_own_process(partial(_engine_version, task.recipe.render.engine))
    shared = replace(task, dataset=absolute(task.dataset), engine_version=version)
    client = _connect(address)
    try:
        yield from _SubmissionWindow(client, ClusterTask(shared, current_build(), timeout_s), deque(indices)).attempts(
            stop
        )
    finally:
        client.close()


class _SubmissionWindow:
    """The frames that wait, and the few that are with the scheduler."""

    def __init__(self, client: Client, task: ClusterTask, waiting: deque[int]) -> None:
        self._client, self._task, self._waiting = client, pickle.dumps(task), waiting
        self._running: dict[int, Future] = {}
        # Frames that Dask gave up: one of them ended workers, and the others may only have stood behind it.
        self._suspects: deque[int] = deque()
        self._alone = False
        # Futures end in a thread of Dask's, and a request to stop comes in a signal handler: both only put.
        self._ended: SimpleQueue[int | None] = SimpleQueue()
        self._threads: dict[str, int] = {}
        self._asked_s = -math.inf
        self._resident_gib: dict[str, float] = {}

    def attempts(self, stop: StopRequest) -> Generator[TaskAttempt[FrameReport], None, None]:
        """Report each frame as it ends; frames that the caller does not wait for any more are cancelled."""
        stop.wake = lambda: self._ended.put(None)
        self._allow_failures(ALLOWED_FAILURES)
        try:
            while self._fill(stop.is_requested):
                index = self._ended.get()
                if index is None:
                    stop.acknowledge(len(self._running))
                    continue
                future = self._running.pop(index)
                yield self._attempt(index, future)
                future.release()
        finally:
            self._client.cancel([*self._running.values()])

    def _fill(self, stopping: bool) -> bool:
        """Hand out frames up to the window's size.

        Returns:
            Whether there is anything to wait for.
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

    def _submit(self, index: int) -> None:
        future = self._client.submit(make_on_worker, self._task, index, pure=False)
        self._running[index] = future
        future.add_done_callback(partial(self._put, index))

    def _put(self, index: int, _: Any) -> None:
        self._ended.put(index)

    def _size(self) -> int:
        if time.monotonic() - self._asked_s > _CREW_EVERY_S:
            self._asked_s, self._threads = time.monotonic(), self._client.nthreads()
            self._resident_gib = {name: gib for name, gib in self._resident_gib.items() if name in self._threads}
        return _FRAMES_PER_WORKER * max(1, sum(self._threads.values()))

    def _allow_failures(self, count: int) -> None:
        self._client.run_on_scheduler(_allow_failures, count=count)

    def _attempt(self, index: int, future: Future) -> TaskAttempt[FrameReport]:
        """How a frame ended.

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
            raise OSError("the Dask scheduler has ended; start it and the same command again to go on") from ended
        except KilledWorker:
            error, final = LostWorkersError(self._alone), self._alone
            if not final:
                self._suspects.append(index)
        except Exception as raised:
            error = raised
        return TaskAttempt(index, 1 + self._alone, value, error, final, sum(self._resident_gib.values()))


def _connect(address: str) -> Client:
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise ValueError("--scheduler: Dask is missing: pip install 'droguekit[cluster]'") from error
    for name in ("distributed", "distributed.client"):  # Dask gives the second a level of its own
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters of it is reported by frame
    try:
        # Every message to the scheduler names the task, and by default a client remembers the last thousand.
        with dask.config.set({"distributed.admin.low-level-log-length": 10}):
            return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise OSError(f"--scheduler: no Dask scheduler answers at {address}: {error}") from error


def _engine_version(name: str) -> str:
    return load_engine(name).version


def _allow_failures(count: int, dask_scheduler: Any) -> None:
    dask_scheduler.allowed_failures = count


def _check_build(wanted: WorkerBuild, here: WorkerBuild, where: str) -> None:
    """See that frames made here are those that the client would make.

    Raises:
        OtherBuildError: they are not; names what differs.
    """
    for name in sorted({name for name, _ in (*wanted.software, *here.software)}):
        there, mine = dict(wanted.software).get(name, "missing"), dict(here.software).get(name, "missing")
        if there != mine:
            raise OtherBuildError(f"{where}: has {name} {mine}, the client {there}; give both the same environment")
    odd = sorted(wanted.cpu_features ^ here.cpu_features)
    if odd:
        raise OtherBuildError(
            f"{where}: its processor differs from the client's in {', '.join(odd)}, and so would last digits; run the "
            "client on a node of the same kind"
        )
