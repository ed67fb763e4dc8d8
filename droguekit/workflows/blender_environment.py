"""Makes a virtual environment with Blender, for Pythons that Blender's package has no wheel for."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from render.blender_engine.interpreter import VARIABLE, blender_environment, environment_python

BPY_OF_PYTHON = {"3.13": "bpy==5.2.3", "3.11": "bpy==5.0.1"}
"""Blender's package by the Python that it has a wheel for, the newest first."""


def make_blender() -> Iterator[str]:
    """Make the environment anew, from a Python that is here or that uv fetches.

    Yields:
        What is being done.

    Raises:
        ValueError: no fitting Python is here, or the package cannot be installed.
        OSError: the environment's folder cannot be written.
    """
    folder = blender_environment()
    part = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.parent.mkdir(parents=True, exist_ok=True)
    try:
        python = _fitting_python()
        if python is not None:
            version, program = python
            yield f"blender    making {folder} with Python {version}, {program}"
            _run([program, "-m", "venv", "--without-pip", str(part)], "the virtual environment cannot be made")
        elif (uv := shutil.which("uv")) is not None:
            version = next(iter(BPY_OF_PYTHON))
            yield f"blender    making {folder} with Python {version} from uv"
            _run([uv, "venv", "--python", version, str(part)], f"uv has no Python {version} here")
        else:
            raise ValueError(
                f"doctor: Blender's package needs Python {' or '.join(BPY_OF_PYTHON)}, and neither is here, nor uv to "
                f"fetch one; install one of them, or name a Blender program in {VARIABLE}"
            )
        package = BPY_OF_PYTHON[version]
        yield f"blender    installing {package} (350 MB)"
        _run([*_installer(environment_python(part)), package], f"{package} cannot be installed")
        shutil.rmtree(folder, ignore_errors=True)
        # Finished environments alone have this name. What is moved are links and packages, which no path holds.
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _fitting_python() -> tuple[str, str] | None:
    """Version and path of a Python that Blender's package has a wheel for."""
    for version in BPY_OF_PYTHON:
        for name in (f"python{version}", sys.executable, "python3", "python"):
            program = shutil.which(name)
            if program is None:
                continue
            code = "import sys, venv; print('%d.%d' % sys.version_info[:2])"
            answer = subprocess.run([program, "-c", code], capture_output=True, text=True, check=False)
            if answer.returncode == 0 and answer.stdout.strip() == version:
                return version, program
    return None


def _installer(python: Path) -> list[str]:
    """Words that install a package for another Python."""
    uv = shutil.which("uv")
    if uv is not None:
        return [uv, "pip", "install", "--python", str(python)]
    return [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(python),
        "install",
        "--no-input",
        "--disable-pip-version-check",
    ]


def _run(command: list[str], fault: str) -> None:
    """Run a program.

    Raises:
        ValueError: it failed; the message has its last line.
    """
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        lines = [line.strip() for line in (ended.stdout + ended.stderr).splitlines() if line.strip()]
        raise ValueError(f"doctor: {fault}: {lines[-1] if lines else f'exit code {ended.returncode}'}")
