"""Folders that all processes of a run of the tests share, for datasets that take long to render."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest


def shared_folder(factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], object]) -> Path:
    """A folder that is filled once, by the process that comes first; the others wait for it.

    Args:
        factory: of the process.
        name: of the contents, unique in the run.
        fill: makes the folder, which does not exist yet, and fills it.

    Returns:
        The folder, to be read only.
    """
    root = factory.getbasetemp()
    # pytest-xdist gives every process a folder of its own within that of the run.
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    place = root / f"shared-{name}"
    place.mkdir(exist_ok=True)
    done, folder = place / "done", place / "dataset"
    with (place / "lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        if not done.exists():
            # What a process left that failed or was killed.
            shutil.rmtree(folder, ignore_errors=True)
            fill(folder)
            done.touch()
    return folder
