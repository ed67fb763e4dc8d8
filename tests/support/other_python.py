"""Runs other people's readers of our files, which need packages that are none of ours, in Pythons of their own."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest


def variable_of(program: str) -> str:
    """Environment variable with the path of the Python that has a program; `make test-readers` sets all."""
    return f"DROGUEKIT_{program.upper()}_PYTHON"


def read_by(program: str, script: str, *arguments: object, folder: Path) -> Any:
    """The JSON that a script prints last in the Python that has a program; skips the test where there is none.

    Args:
        program: such as `datumaro`.
        script: its text.
        arguments: of the script.
        folder: to run in and to keep settings in.
    """
    python = os.environ.get(variable_of(program))
    if python is None:
        pytest.skip(f"{variable_of(program)} names no Python that has {program}")
    own = {"PYTHONPATH": "", "HOME": str(folder), "YOLO_CONFIG_DIR": str(folder)}
    command = [python, "-c", script, *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, env={**os.environ, **own}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])
