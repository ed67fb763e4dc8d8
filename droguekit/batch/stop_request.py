"""The first Ctrl-C finishes running tasks, the second stops at once."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

# A cluster asks a job to end with SIGTERM.
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """While entered, the first Ctrl-C or SIGTERM is a request, and the second raises `KeyboardInterrupt`.

    It can be waited for like a connection: it becomes readable when the request comes.

    Attributes:
        is_requested: whether the first signal has come.
        say: prints a line for the user.
        wake: called then, in the signal handler, for code that does not wait for the descriptor.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        """Take the function that prints a line for the user."""
        self.is_requested = False
        self.wake: Callable[[], object] | None = None
        self.say = say
        self._before: dict[signal.Signals, Any] = {}
        self._reader = self._writer = -1

    def __enter__(self) -> Self:
        """Install the signal handlers; outside the main thread, where Python allows none, nothing changes."""
        self._reader, self._writer = os.pipe()
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._hear) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the signal handlers."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._reader)
        os.close(self._writer)

    def fileno(self) -> int:
        """The descriptor that becomes readable."""
        return self._reader

    def acknowledge(self, in_hand: int) -> None:
        """Tell the user what happens next."""
        self.say(
            f"stopping after the running frames ({in_hand}); press Ctrl-C again to stop at once and lose only those"
        )

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self.is_requested:
            raise KeyboardInterrupt
        self.is_requested = True
        os.write(self._writer, b"!")
        if self.wake is not None:
            self.wake()
