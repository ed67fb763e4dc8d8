"""Many tasks in worker processes: an accident costs one attempt of one task, and the others go on."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar, cast

from droguekit.batch.execution import resident_gib
from droguekit.batch.stop_request import StopRequest
from droguekit.numerical_threads import one_thread_in_new_processes

READY, UNTIMED = "ready", "untimed"
_CONTEXT = multiprocessing.get_context("spawn")
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkerDiedError(OSError):
    """The process of a task ended before the task did."""

    def __init__(self, exit_code: int | None) -> None:
        """With the exit code as `multiprocessing` gives it: negative for a signal."""
        super().__init__(f"its worker process died ({_exit_text(exit_code)})")
        self.exit_code = exit_code


class TaskTimeoutError(OSError):
    """A task was still at work after its time."""

    def __init__(self, timeout_s: float) -> None:
        """With the time it had. [s]"""
        super().__init__(f"it was still at work after {timeout_s:g} s and was stopped")


class Worker:
    """A process that works on at most one task; nothing of it is shared with another one."""

    def __init__(self, function: Callable[[int], Any], then: Callable[[int, Any], Any] | None = None) -> None:
        """Start it; it says `READY` once it can take tasks.

        Args:
            function: of each index.
            then: makes of an index and its value what is sent back; it says `UNTIMED` before.

        Raises:
            OSError: it cannot be started.
        """
        self.connection, there = _CONTEXT.Pipe()
        self._process = _CONTEXT.Process(
            target=_serve, args=(there, function, then, os.getpid()), name="droguekit-worker"
        )
        with one_thread_in_new_processes():
            self._process.start()
        there.close()
        self.index: int | None = None
        self.is_ready = False
        self.tasks_done = 0
        self.resident_gib = 0.0
        self.is_timed = False
        self._began_s = 0.0

    def give(self, index: int) -> None:
        """Let it begin a task; that it is dead already shows when its answer is received."""
        self.index, self.is_timed = index, True
        self._began_s = time.monotonic()
        with suppress(OSError):
            self.connection.send(index)

    def seconds_left(self, timeout_s: float) -> float:
        """How long its task may go on; the clock is one that nobody sets. [s]"""
        return self._began_s + timeout_s - time.monotonic()

    def receive(self) -> Any:
        """What it sent.

        Raises:
            WorkerDiedError: it has ended without an answer.
        """
        try:
            return self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            self.kill()
            raise WorkerDiedError(self._process.exitcode) from error

    def kill(self) -> None:
        """End it at once, with all processes that it has started."""
        try:
            os.killpg(self._process.pid or 0, signal.SIGKILL)
        except ProcessLookupError:
            self._process.kill()  # it has no group of its own yet, or has ended
        self._process.join()
        self.connection.close()

    def dismiss(self) -> None:
        """Let it end by itself; it holds no task."""
        self.connection.close()
        self._process.join()


def _serve(
    connection: Connection[Any, Any],
    function: Callable[[int], Any],
    then: Callable[[int, Any], Any] | None,
    parent: int,
) -> None:
    """The life of a worker: answers each index with (value, error, resident memory in GiB)."""
    # A group of its own: Ctrl-C at the terminal reaches the parent alone, and a kill reaches what an engine started.
    os.setpgid(0, 0)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a cluster that ends a job tells every process; the parent decides
    _die_with_parent(parent)
    connection.send(READY)
    while True:
        try:
            index = connection.recv()
        except EOFError:
            return
        value, error = None, None
        try:
            value = function(index)
            if then is not None:
                connection.send(UNTIMED)
                value = then(index, value)
        except Exception as raised:
            value, error = None, _picklable(raised)
        connection.send((value, error, resident_gib()))


def _die_with_parent(parent: int) -> None:
    """Let the kernel kill this process when its parent ends, however it ends and whatever this process does."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # it had ended before


def _picklable(error: Exception) -> Exception:
    """The error, or one that says the same where it cannot cross to another process; with its traceback as a note."""
    note = "".join(traceback.format_exception(error))
    try:
        copy: Exception = pickle.loads(pickle.dumps(error))
        same = type(copy) is type(error) and str(copy) == str(error)
    except Exception:  # whatever a foreign class does wrong
        same = False
    carried = error if same else ValueError(f"{type(error).__name__}: {error}")
    carried.add_note(f"In the worker process:\n{note}")
    return carried


def _exit_text(exit_code: int | None) -> str:
    if exit_code is None or exit_code >= 0:
        return f"exit code {exit_code}"
    try:
        return signal.Signals(-exit_code).name
    except ValueError:
        return f"signal {-exit_code}"


T = TypeVar("T")

MAX_ATTEMPTS = 3


@dataclass(frozen=True)
class WorkerLimits:
    """What a worker may take.

    Attributes:
        timeout_s: for one task, from its start; None for any. [s]
        tasks_per_process: before a fresh process takes over: renderers keep some memory with every frame.
        process_gib: a process that holds more after a task is replaced; None for any. [GiB]
    """

    timeout_s: float | None = None
    tasks_per_process: int = 500
    process_gib: float | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: one is not positive.
        """
        for name in ("timeout_s", "tasks_per_process", "process_gib"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: must be above 0, got {value:g}")


@dataclass(frozen=True)
class TaskAttempt(Generic[T]):
    """How one attempt at one task ended.

    Attributes:
        index: of the task.
        number: 1 for the first attempt.
        value: what the task returned, or None.
        error: what it raised, `WorkerDiedError` when its process died, `TaskTimeoutError` when it took too long.
        final: whether the task is not tried again.
        workers_gib: memory that the workers held together when they last told, 0.0 where they do not. [GiB]
    """

    index: int
    number: int
    value: T | None
    error: BaseException | None
    final: bool
    workers_gib: float = 0.0


def is_accident(error: BaseException | None) -> bool:
    """Whether an attempt failed in a way that another one may not."""
    return isinstance(error, WorkerDiedError | TaskTimeoutError | MemoryError)


def run_tasks(
    function: Callable[[int], T],
    indices: Iterable[int],
    workers: int,
    limits: WorkerLimits | None = None,
    stop: StopRequest | None = None,
    then: Callable[[int, T], T] | None = None,
) -> Generator[TaskAttempt[T], None, None]:
    """Run `function(index)` for every index in worker processes, and report each attempt as it ends.

    An attempt whose process dies or that takes too long is repeated, up to `MAX_ATTEMPTS`; one that raises is not.
    Closing the iterator kills the workers.

    Args:
        function: can be pickled.
        indices: of the tasks, without repetition.
        workers: number of processes; 0 runs in this process, for debugging, without limits.
        limits: what a worker may take.
        stop: once it is requested, no more tasks begin, and the iterator ends with those that are running.
        then: follows on a task in the same process and has any time; makes of its index and value what is reported.

    Raises:
        OSError: worker processes cannot be started.
    """
    if workers == 0:
        for index in indices:
            if stop is None or not stop.is_requested:
                yield _attempt_here(function, then, index)
        return
    crew = _WorkerPool[T](partial(Worker, function, then), deque(indices), workers, limits or WorkerLimits())
    try:
        while crew.fill(stop is not None and stop.is_requested):
            yield from crew.attempts(stop)
    finally:
        crew.kill()


def _attempt_here(function: Callable[[int], T], then: Callable[[int, T], T] | None, index: int) -> TaskAttempt[T]:
    try:
        value = function(index)
        return TaskAttempt(index, 1, value if then is None else then(index, value), None, final=True)
    except Exception as error:
        return TaskAttempt(index, 1, None, error, final=True)


class _WorkerPool(Generic[T]):
    """The workers of one run, the tasks that wait, and how often each task has failed."""

    def __init__(self, start: Callable[[], Worker], waiting: deque[int], size: int, limits: WorkerLimits) -> None:
        self._start, self._waiting, self._size, self._limits = start, waiting, size, limits
        self._workers: list[Worker] = []
        self._failures: Counter[int] = Counter()
        self._deaths_at_start = 0

    def fill(self, stopping: bool) -> bool:
        """Give every worker that has none a task, and start the workers that are missing.

        Returns:
            Whether there is anything to wait for.
        """
        if stopping:
            self._waiting.clear()
        for worker in [worker for worker in self._workers if worker.is_ready and worker.index is None]:
            if self._waiting:
                worker.give(self._waiting.popleft())
        starting = sum(not worker.is_ready for worker in self._workers)
        for _ in range(min(self._size - len(self._workers), len(self._waiting) - starting)):
            self._workers.append(self._start())
        return bool(self._waiting) or any(worker.index is not None for worker in self._workers)

    def attempts(self, stop: StopRequest | None) -> Iterator[TaskAttempt[T]]:
        """Wait until something happens, and report the attempts that have ended with it."""
        busy = [worker for worker in self._workers if worker.index is not None]
        awaited: list[Any] = [worker.connection for worker in self._workers]
        if stop is not None and not stop.is_requested:
            awaited.append(stop.fileno())
        patience_s = None
        timed = [worker for worker in busy if worker.is_timed]
        if self._limits.timeout_s is not None and timed:
            patience_s = max(0.0, min(worker.seconds_left(self._limits.timeout_s) for worker in timed))
        ready = wait(awaited, patience_s)
        if stop is not None and stop.fileno() in ready:
            stop.acknowledge(len(busy))
        for worker in [worker for worker in self._workers if worker.connection in ready]:
            yield from self._hear(worker)
        for worker in [worker for worker in timed if worker in self._workers and worker.is_timed]:
            if self._limits.timeout_s is not None and worker.seconds_left(self._limits.timeout_s) <= 0:
                yield self._fail(worker, TaskTimeoutError(self._limits.timeout_s))

    def _hear(self, worker: Worker) -> Iterator[TaskAttempt[T]]:
        try:
            message = worker.receive()
        except WorkerDiedError as error:
            if worker.index is not None:
                yield self._fail(worker, error)
            else:
                self._lose_idle(worker, error)
            return
        if message == READY:
            worker.is_ready = True
            self._deaths_at_start = 0
            return
        if message == UNTIMED:
            worker.is_timed = False
            return
        value, raised, worker.resident_gib = message
        index = cast(int, worker.index)
        if is_accident(raised):
            yield self._fail(worker, raised)
            return
        worker.index, worker.is_timed = None, False
        worker.tasks_done += 1
        workers_gib = self._resident_gib()
        if worker.tasks_done >= self._limits.tasks_per_process or (
            self._limits.process_gib is not None and worker.resident_gib > self._limits.process_gib
        ):
            self._workers.remove(worker)
            worker.dismiss()
        yield TaskAttempt(index, self._failures[index] + 1, value, raised, True, workers_gib)

    def _fail(self, worker: Worker, error: BaseException) -> TaskAttempt[T]:
        """End a worker by whose accident a task has failed; the task waits for its next attempt if it has one."""
        index = cast(int, worker.index)
        self._workers.remove(worker)
        worker.kill()
        self._failures[index] += 1
        final = self._failures[index] >= MAX_ATTEMPTS
        if not final:
            self._waiting.append(index)
        return TaskAttempt(index, self._failures[index], None, error, final, self._resident_gib())

    def _resident_gib(self) -> float:
        return sum(worker.resident_gib for worker in self._workers)

    def _lose_idle(self, worker: Worker, error: WorkerDiedError) -> None:
        """A death without a task costs none; but workers that die before their first one are no accident.

        Raises:
            OSError: they die again and again.
        """
        self._workers.remove(worker)
        self._deaths_at_start += not worker.is_ready
        if self._deaths_at_start >= max(MAX_ATTEMPTS, self._size):
            raise OSError(f"worker processes end before their first task; the last: {error}") from error

    def kill(self) -> None:
        """End all workers at once."""
        for worker in self._workers:
            worker.kill()
        self._workers.clear()


def run_in_own_process(function: Callable[[], T]) -> T:
    """Run one function in a worker process of its own and return what it returns.

    Raises:
        Exception: what the function raises, or `WorkerDiedError` when its process dies again and again.
    """
    with closing(run_tasks(partial(_call, function), [0], workers=1)) as attempts:
        last = [*attempts][-1]
    if last.error is not None:
        raise last.error
    return cast(T, last.value)


def _call(function: Callable[[], T], _: int) -> T:
    return function()
