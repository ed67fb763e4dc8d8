"""Commands of droguekit, run by studies as a user runs them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

# As a shell's: stopped by Ctrl-C.
_INTERRUPTED = 130


def run_droguekit(*words: object, log: Path) -> None:
    """Run a command of droguekit in a process of its own, and append what it prints to a file.

    Raises:
        OSError: it failed or was interrupted; names the log and its last line.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as lines:
        ended = subprocess.run(
            # -P: a file in the working folder must not replace a module of ours.
            [sys.executable, "-P", "-m", "droguekit.cli.main", *map(str, words)],
            stdout=lines,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            check=False,
        )
    if ended.returncode == _INTERRUPTED:
        raise OSError(f"{log}: droguekit {words[0]} was interrupted; the same command resumes it")
    if ended.returncode != 0:
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise OSError(f"{log}: {said[-1] if said else f'droguekit {words[0]} failed silently'}")
