"""Worker processes: one task at a time each, one thread each, and a killed one costs one attempt of one task."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Generic, TypeVar, cast

from pebble import ProcessExpired, ProcessPool

T = TypeVar("T")

MAX_ATTEMPTS = 3
# Renderers keep some memory with every frame; a fresh process gives it back.
TASKS_PER_PROCESS = 200
# A worker with the engine loaded and a 1280 x 960 pair in work stays below this.
GIB_PER_WORKER = 1.5
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


@dataclass(frozen=True)
class Attempt(Generic[T]):
    """How one attempt at one task ended.

    Attributes:
        index: of the task.
        number: 1 for the first attempt.
        value: what the task returned, or None.
        error: what it raised, or `ProcessExpired` when its process died.
        final: whether the task is not tried again.
    """

    index: int
    number: int
    value: T | None
    error: BaseException | None
    final: bool


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def available_memory_gib() -> float:
    """Memory that is free for new processes, by the kernel's and the container's account. [GiB]"""
    free = [_meminfo_available()]
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text(encoding="ascii").strip()
        if limit != "max":
            free.append(int(limit) - int((group / "memory.current").read_text(encoding="ascii")))
    except (OSError, ValueError):
        pass  # no container limit is in force
    return max(0.0, min(free) / 2**30)


def _meminfo_available() -> float:
    for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
        if line.startswith("MemAvailable:"):
            return float(line.split()[1]) * 1024
    raise ValueError("/proc/meminfo: names no MemAvailable")


def default_workers() -> int:
    """As many workers as there are cores, and as the memory holds."""
    return max(1, min(available_cores(), int(available_memory_gib() / GIB_PER_WORKER)))


@contextmanager
def _children_with_one_thread() -> Iterator[None]:
    """Let processes that start meanwhile use one thread each; libraries read these variables when they load."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """Make this worker end at once when the process that started it does, even by a kill."""
    parent = multiprocessing.parent_process()
    if parent is None:
        raise ValueError("worker: must run in a process of its own")

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True, name="end-with-parent").start()


def run_tasks(function: Callable[[int], T], indices: Iterable[int], workers: int) -> Generator[Attempt[T], None, None]:
    """Run `function(index)` for every index in worker processes, and report each attempt as it ends.

    An attempt whose process dies is repeated, up to `MAX_ATTEMPTS`; one that raises is not. Closing the iterator ends
    the workers.

    Args:
        function: can be pickled.
        indices: of the tasks, without repetition.
        workers: number of processes; 0 runs in this process, for debugging.
    """
    if workers == 0:
        yield from (_attempt_here(function, index) for index in indices)
        return
    waiting = deque(indices)
    deaths: Counter[int] = Counter()
    pools_left = MAX_ATTEMPTS
    with _children_with_one_thread():
        while waiting:
            try:
                yield from _run_in_one_pool(function, waiting, deaths, workers)
            except BrokenProcessPool:
                # A worker died between two tasks, which leaves the pool unusable but costs no task.
                pools_left -= 1
                if pools_left == 0:
                    raise


def _attempt_here(function: Callable[[int], T], index: int) -> Attempt[T]:
    try:
        return Attempt(index, 1, function(index), None, final=True)
    except Exception as error:
        return Attempt(index, 1, None, error, final=True)


def _run_in_one_pool(
    function: Callable[[int], T], waiting: deque[int], deaths: Counter[int], workers: int
) -> Iterator[Attempt[T]]:
    """Work through `waiting` until it is empty; what is unfinished stays in it."""
    pool = ProcessPool(
        max_workers=workers,
        max_tasks=TASKS_PER_PROCESS,
        initializer=_end_with_parent,
        context=multiprocessing.get_context("spawn"),
    )
    ended: SimpleQueue[tuple[int, Future[T]]] = SimpleQueue()
    running: set[int] = set()
    try:
        while waiting or running:
            # One task more than workers, so that none waits for the next.
            while waiting and len(running) <= workers:
                index = waiting.popleft()
                running.add(index)
                future: Future[T] = pool.schedule(function, args=[index])
                future.add_done_callback(lambda future, index=index: ended.put((index, future)))  # type: ignore[misc]
            index, future = ended.get()
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                raise error
            running.discard(index)
            final = True
            if isinstance(error, ProcessExpired):
                deaths[index] += 1
                final = deaths[index] >= MAX_ATTEMPTS
                if not final:
                    waiting.append(index)
            value = None if error is not None else future.result()
            number = deaths[index] + (0 if isinstance(error, ProcessExpired) else 1)
            yield Attempt(index, number, value, error, final)
    finally:
        waiting.extend(sorted(running))
        pool.stop()
        pool.join()


def run_alone(function: Callable[[], T]) -> T:
    """Run one function in a worker process of its own and return what it returns.

    Raises:
        Exception: what the function raises, or `ProcessExpired` when its process dies again and again.
    """
    with closing(run_tasks(partial(_call, function), [0], workers=1)) as attempts:
        last = [*attempts][-1]
    if last.error is not None:
        raise last.error
    return cast(T, last.value)


def _call(function: Callable[[], T], _: int) -> T:
    return function()
