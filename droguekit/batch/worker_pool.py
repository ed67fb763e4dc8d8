"""Run many tasks in worker processes, so that a crash costs one attempt of one task and the others continue."""

from __future__ import annotations

import ctypes
import fcntl
import multiprocessing
import os
import pickle
import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar, cast

from datasets_manifest.atomic import remove_scratch_folders
from droguekit.batch.execution import GIB_PER_WORKER, resident_gib, return_free_memory
from droguekit.batch.stop_request import StopRequest
from droguekit.batch.task_queue import TaskQueue
from droguekit.numerical_threads import one_thread_in_new_processes

READY, UNTIMED = "ready", "untimed"
_CONTEXT = multiprocessing.get_context("spawn")
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
T = TypeVar("T")
MAX_ATTEMPTS = 3
_MOST_OUTPUT = 4000
# Above `GIB_PER_WORKER` a worker gives memory back when it has grown by this: that takes a tenth of a second.
_GROWTH_GIB = 0.15


_NATIVE_FAULTS = (signal.SIGILL, signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE)


class WorkerDiedError(OSError):
    """The process of a task ended before the task did."""

    def __init__(self, exit_code: int | None) -> None:
        """Take the exit code of `multiprocessing`, which is negative for a signal."""
        super().__init__(f"its worker process died ({_exit_text(exit_code)})")
        self.exit_code = exit_code

    @property
    def is_of_native_code(self) -> bool:
        """Whether the process ended by a signal for wrong instructions, memory accesses or assertions."""
        return self.exit_code is not None and -self.exit_code in _NATIVE_FAULTS


class TaskTimeoutError(OSError):
    """A task ran longer than its time limit."""

    def __init__(self, timeout_s: float) -> None:
        """Take the time limit. [s]"""
        super().__init__(f"it was still at work after {timeout_s:g} s and was stopped")


class Worker:
    """A process that works on at most one task and shares nothing with other workers."""

    def __init__(self, function: Callable[[int], Any], then: Callable[[int, Any], Any] | None = None) -> None:
        """Start the process, which sends `READY` once it can take tasks.

        Args:
            function: is called with each index.
            then: turns an index and its value into what is sent back, without time limit; `UNTIMED` is sent before.

        Raises:
            OSError: it cannot be started.
        """
        self.connection, there = _CONTEXT.Pipe()
        # In memory, so that a run that is killed leaves no file. A connection takes its descriptor to the process.
        self._output = os.memfd_create("droguekit-worker")
        fcntl.fcntl(self._output, fcntl.F_SETFL, os.O_APPEND)
        output: Connection[Any, Any] = Connection(os.dup(self._output), readable=False)
        self._process = _CONTEXT.Process(target=_serve, args=(there, output, os.getpid()), name="droguekit-worker")
        with one_thread_in_new_processes():
            self._process.start()
        there.close()
        output.close()
        # Not as arguments of the process: `multiprocessing` waits for ever to hand over more than a pipe holds, such as
        # a long recipe, to a process that has ended. Here a dead one shows when its answer is received.
        with suppress(OSError):
            self.connection.send((function, then))
        self.index: int | None = None
        self.group: int | None = None
        self.is_ready = False
        self.tasks_done = 0
        self.resident_gib = 0.0
        self.is_timed = False
        self._began_s = 0.0

    def assign(self, index: int) -> None:
        """Start a task; a worker that is already dead shows when its answer is received."""
        self.index, self.is_timed = index, True
        self._began_s = time.monotonic()
        with suppress(OSError):
            self.connection.send(index)

    def seconds_left(self, timeout_s: float) -> float:
        """Time left for its task, by the monotonic clock. [s]"""
        return self._began_s + timeout_s - time.monotonic()

    def receive(self) -> Any:
        """Receive what it sent.

        Raises:
            WorkerDiedError: it ended without an answer.
        """
        try:
            return self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            self.kill()
            raise WorkerDiedError(self._process.exitcode) from error

    def take_output(self) -> str:
        """What it wrote to standard output and error since the last call, as a compiler in it does; the end of it."""
        size = os.fstat(self._output).st_size
        data = os.pread(self._output, _MOST_OUTPUT, max(0, size - _MOST_OUTPUT)) if size else b""
        os.ftruncate(self._output, 0)
        return data.decode("utf-8", "replace").strip()

    def kill(self) -> None:
        """Kill it with all processes that it started."""
        try:
            os.killpg(self._process.pid or 0, signal.SIGKILL)
        except ProcessLookupError:
            self._process.kill()  # it has no process group yet, or has ended
        self._process.join()
        self.connection.close()
        remove_scratch_folders(self._process.pid or 0)

    def __del__(self) -> None:
        """Forget what it wrote."""
        with suppress(AttributeError, OSError):
            os.close(self._output)

    def shut_down(self) -> None:
        """Let it end; it has no task."""
        self.connection.close()
        self._process.join()


def _serve(
    connection: Connection[Any, Any],
    output: Connection[Any, Any],
    parent: int,
) -> None:
    """The main loop of a worker: answers each index with (value, error, resident memory in GiB)."""
    # In a process group of its own, Ctrl-C reaches only the parent, and a kill also reaches what an engine started.
    os.setpgid(0, 0)
    # Several processes at a terminal would write into each other's lines, and into those of the progress.
    for standard in (1, 2):
        os.dup2(output.fileno(), standard)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a cluster sends it to every process of a job; the parent decides
    _die_with_parent(parent)
    try:
        function, then = connection.recv()
    except EOFError:
        return
    connection.send(READY)
    kept_gib = 0.0
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
        if resident_gib() > max(GIB_PER_WORKER, kept_gib + _GROWTH_GIB):
            return_free_memory()
            kept_gib = resident_gib()
        connection.send((value, error, resident_gib()))


def _die_with_parent(parent: int) -> None:
    """Let the kernel kill this process when its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # the parent has ended already


def _picklable(error: Exception) -> Exception:
    """The error with its traceback as a note, or a `ValueError` with its message where it cannot be pickled."""
    note = "".join(traceback.format_exception(error))
    try:
        copy: Exception = pickle.loads(pickle.dumps(error))
        same = type(copy) is type(error) and str(copy) == str(error)
    except Exception:  # foreign classes may fail in any way
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


@dataclass(frozen=True)
class WorkerLimits:
    """Limits of a worker.

    Attributes:
        timeout_s: for one task, from its start; None for no limit. [s]
        tasks_per_process: after which the process is replaced, since renderers leak some memory with every frame.
        process_gib: a process that holds more memory after a task is replaced; None for no limit. [GiB]
        is_first_alone: whether one worker ends its first task before the others start, as it fills a cache for them.
    """

    timeout_s: float | None = None
    tasks_per_process: int = 500
    process_gib: float | None = None
    is_first_alone: bool = False

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
    """The outcome of one attempt at a task.

    Attributes:
        index: of the task.
        number: 1 for the first attempt.
        value: what the task returned, or None.
        error: what it raised, `WorkerDiedError` when its process died, `TaskTimeoutError` when it took too long.
        final: whether this was the last attempt.
        workers_gib: memory of all workers together after their latest tasks, 0.0 where unknown. [GiB]
        output: what its process wrote to standard output and error meanwhile, the end of it.
    """

    index: int
    number: int
    value: T | None
    error: BaseException | None
    final: bool
    workers_gib: float = 0.0
    output: str = ""


def is_accident(error: BaseException | None) -> bool:
    """Whether another attempt may succeed: the process died, took too long, or ran out of memory."""
    return isinstance(error, WorkerDiedError | TaskTimeoutError | MemoryError)


def run_tasks(
    function: Callable[[int], T],
    indices: Iterable[int],
    workers: int,
    limits: WorkerLimits | None = None,
    stop: StopRequest | None = None,
    then: Callable[[int, T], T] | None = None,
    group_of: Callable[[int], int] | None = None,
) -> Generator[TaskAttempt[T], None, None]:
    """Run `function(index)` for every index in worker processes, and report each attempt as it ends.

    An attempt whose process dies or that takes too long is repeated, up to `MAX_ATTEMPTS`; one that raises is not.
    Closing the iterator kills the workers.

    Args:
        function: can be pickled.
        indices: of the tasks, each once.
        workers: number of processes; 0 runs in this process, for debugging, without limits.
        limits: of each worker.
        stop: once it is requested, no more tasks start, and the iterator ends after the running ones.
        then: runs after a task in the same process without time limit; turns index and value into what is reported.
        group_of: number of the group of each task. A process does the tasks of a group one after the other, because
            they share what is made once for the first; None keeps the order of the indices.

    Raises:
        OSError: worker processes cannot be started.
    """
    waiting = TaskQueue(indices, group_of)
    if workers == 0:
        group = None
        while waiting and not (stop is not None and stop.is_requested):
            index, group = waiting.take(group)
            yield _attempt_here(function, then, index)
        return
    pool = _WorkerPool[T](partial(Worker, function, then), waiting, workers, limits or WorkerLimits())
    try:
        while pool.fill(stop is not None and stop.is_requested):
            yield from pool.attempts(stop)
    finally:
        pool.kill()


def _attempt_here(function: Callable[[int], T], then: Callable[[int, T], T] | None, index: int) -> TaskAttempt[T]:
    try:
        value = function(index)
        return TaskAttempt(index, 1, value if then is None else then(index, value), None, final=True)
    except Exception as error:
        return TaskAttempt(index, 1, None, error, final=True)


class _WorkerPool(Generic[T]):
    """The workers of a run, the waiting tasks, and how often each task has failed."""

    def __init__(self, start: Callable[[], Worker], waiting: TaskQueue, size: int, limits: WorkerLimits) -> None:
        self._start, self._waiting, self._size, self._limits = start, waiting, size, limits
        self._workers: list[Worker] = []
        self._failures: Counter[int] = Counter()
        self._may_share = not limits.is_first_alone
        self._deaths_at_start = 0

    def fill(self, stopping: bool) -> bool:
        """Give idle workers tasks, each of the group that it is at while there are any, and start missing workers.

        Returns:
            Whether any task waits or runs.
        """
        if stopping:
            self._waiting.clear()
        for worker in [worker for worker in self._workers if worker.is_ready and worker.index is None]:
            if self._waiting:
                held = {other.group for other in self._workers if other is not worker and other.group is not None}
                index, worker.group = self._waiting.take(worker.group, held)
                worker.assign(index)
        starting = sum(not worker.is_ready for worker in self._workers)
        size = self._size if self._may_share else 1
        for _ in range(min(size - len(self._workers), len(self._waiting) - starting)):
            self._workers.append(self._start())
        return bool(self._waiting) or any(worker.index is not None for worker in self._workers)

    def attempts(self, stop: StopRequest | None) -> Iterator[TaskAttempt[T]]:
        """Wait until something happens, and report the attempts that ended."""
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
            yield from self._handle_message(worker)
        for worker in [worker for worker in timed if worker in self._workers and worker.is_timed]:
            if self._limits.timeout_s is not None and worker.seconds_left(self._limits.timeout_s) <= 0:
                yield self._fail(worker, TaskTimeoutError(self._limits.timeout_s))

    def _handle_message(self, worker: Worker) -> Iterator[TaskAttempt[T]]:
        try:
            message = worker.receive()
        except WorkerDiedError as error:
            if worker.index is not None:
                yield self._fail(worker, error)
            else:
                self._remove_idle(worker, error)
            return
        if message == READY:
            worker.is_ready = True
            self._deaths_at_start = 0
            return
        if message == UNTIMED:
            worker.is_timed = False
            return
        value, raised, worker.resident_gib = message
        index, output = cast(int, worker.index), worker.take_output()
        self._may_share = True
        if is_accident(raised):
            yield self._fail(worker, raised, output)
            return
        worker.index, worker.is_timed = None, False
        worker.tasks_done += 1
        workers_gib = self._resident_gib()
        if worker.tasks_done >= self._limits.tasks_per_process or (
            self._limits.process_gib is not None and worker.resident_gib > self._limits.process_gib
        ):
            self._workers.remove(worker)
            worker.shut_down()
        yield TaskAttempt(index, self._failures[index] + 1, value, raised, True, workers_gib, output)

    def _fail(self, worker: Worker, error: BaseException, output: str = "") -> TaskAttempt[T]:
        """Kill the worker of a failed task, and queue the task again if it has attempts left."""
        index = cast(int, worker.index)
        self._workers.remove(worker)
        worker.kill()
        output = output or worker.take_output()
        self._failures[index] += 1
        final = self._failures[index] >= MAX_ATTEMPTS
        if not final:
            self._waiting.add(index)
        self._may_share = self._may_share or final
        return TaskAttempt(index, self._failures[index], None, error, final, self._resident_gib(), output)

    def _resident_gib(self) -> float:
        return sum(worker.resident_gib for worker in self._workers)

    def _remove_idle(self, worker: Worker, error: WorkerDiedError) -> None:
        """Remove a worker that died without a task.

        Raises:
            OSError: workers die again and again before their first task.
        """
        self._workers.remove(worker)
        self._deaths_at_start += not worker.is_ready
        if self._deaths_at_start >= max(MAX_ATTEMPTS, self._size):
            said = worker.take_output().splitlines()[-1:]
            reason = "; it said: ".join([str(error), *said])
            raise OSError(f"worker processes end before their first task; the last: {reason}") from error

    def kill(self) -> None:
        """Kill all workers."""
        for worker in self._workers:
            worker.kill()
        self._workers.clear()


def run_in_own_process(function: Callable[[], T]) -> T:
    """Run a function in a process of its own and return its value.

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
