"""One worker process: takes a task, sends back how it ended, takes the next; and the handle that its parent holds."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

from droguekit.batch.machine import resident_gib
from droguekit.numerical_threads import one_thread_in_new_processes

READY, UNTIMED = "ready", "untimed"
_CONTEXT = multiprocessing.get_context("spawn")
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class WorkerDiedError(OSError):
    """The process of a task ended before the task did."""

    def __init__(self, exit_code: int | None) -> None:
        """With the exit code as `multiprocessing` gives it: negative for a signal."""
        super().__init__(f"its worker process died ({_ending(exit_code)})")
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
    _end_with(parent)
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
            value, error = None, _portable(raised)
        connection.send((value, error, resident_gib()))


def _end_with(parent: int) -> None:
    """Let the kernel kill this process when its parent ends, however it ends and whatever this process does."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # it had ended before


def _portable(error: Exception) -> Exception:
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


def _ending(exit_code: int | None) -> str:
    if exit_code is None or exit_code >= 0:
        return f"exit code {exit_code}"
    try:
        return signal.Signals(-exit_code).name
    except ValueError:
        return f"signal {-exit_code}"
