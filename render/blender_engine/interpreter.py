"""Which interpreter runs Blender: this Python, another one that has `bpy`, or a Blender program."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

VARIABLE = "DROGUEKIT_BLENDER"
"""Environment variable with the path of a Python that has `bpy`, or of a Blender program."""
OLDEST_BLENDER = "5.0"
# A fresh Python on a slow disk; Blender's program answers in a second.
_ANSWER_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class BlenderInterpreter:
    """An interpreter that has Blender, or should have it.

    Attributes:
        path: of a Python, or of a Blender program.
        origin: why this one, in words.
    """

    path: Path
    origin: str

    @property
    def is_this_python(self) -> bool:
        """Whether it is the Python that runs this."""
        return self.path == Path(sys.executable)

    def command(self, code: str) -> list[str]:
        """Words that run Python code with Blender.

        Raises:
            ValueError: the program does not run, or is neither a Python nor Blender.
        """
        if self.is_this_python:
            # -P: a file in the working folder must not replace one of Blender's modules.
            return [sys.executable, "-P", "-c", code]
        if self._kind() == "Python":
            # -I: the packages of this Python, where PYTHONPATH names them, are not for that one.
            return [str(self.path), "-I", "-c", code]
        options = ["--background", "--factory-startup", "--python-exit-code", "1"]
        return [str(self.path), *options, "--python-expr", code]

    def _kind(self) -> str:
        """`Python` or `Blender`, by what it says of its version."""
        try:
            answer = subprocess.run(
                [str(self.path), "--version"], capture_output=True, text=True, timeout=_ANSWER_TIMEOUT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ValueError(f"{self.path} does not run: {error}") from error
        for line in answer.stdout.splitlines():
            for kind in ("Python", "Blender"):
                if line.startswith(f"{kind} "):
                    return kind
        raise ValueError(f"{self.path} is neither a Python with bpy nor a Blender program")


def blender_environment() -> Path:
    """Folder of the virtual environment with Blender that `droguekit doctor --make-blender` makes."""
    data = os.environ.get("XDG_DATA_HOME")
    return (Path(data) if data else Path.home() / ".local" / "share") / "droguekit" / "blender"


def environment_python(environment: Path) -> Path:
    """The Python of a virtual environment."""
    return environment / "bin" / "python"


def find_blender() -> BlenderInterpreter:
    """The interpreter for Blender: the one that the user names, then this Python, then what was made, then a program.

    Raises:
        ValueError: there is none, or the named one does not exist; the message says what to do.
    """
    named = os.environ.get(VARIABLE)
    if named:
        path = shutil.which(named)
        if path is None:
            raise ValueError(f"engine blender: {VARIABLE}={named} is not a program")
        return BlenderInterpreter(Path(path).absolute(), f"named in {VARIABLE}")
    if _has_bpy():
        return BlenderInterpreter(Path(sys.executable), "this Python")
    made = environment_python(blender_environment())
    if made.exists():
        return BlenderInterpreter(made, "made by droguekit doctor --make-blender")
    program = shutil.which("blender")
    if program is not None:
        return BlenderInterpreter(Path(program).absolute(), "on the search path")
    raise ValueError(
        "engine blender: no Blender is here; make one with: droguekit doctor --make-blender (or name a Python that has "
        f"bpy, or a Blender program, in {VARIABLE})"
    )


def _has_bpy() -> bool:
    """Whether this Python has Blender's package, which is not imported for this."""
    try:
        version("bpy")
    except PackageNotFoundError:
        return False
    return True
