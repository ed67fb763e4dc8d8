"""One process at a time in a place."""

from __future__ import annotations

import fcntl
from typing import IO


def takes_lock(file: IO[str]) -> bool:
    """Whether an open file was nobody's and is now this process's, until it is closed.

    The kernel frees the lock when the process ends, however it ends.

    Raises:
        OSError: the file system knows no locks.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
