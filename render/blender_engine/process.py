"""Blender in a process of its own: started with the engine, ended with it, and told what to draw in between."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import weakref
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from render.blender_engine.messages import FrameSetup, Picture

_MEMORY_FOLDER = Path("/dev/shm")
_GRACE_S = 5.0


class BlenderEndedError(RuntimeError):
    """Blender's process ended by itself."""


def bpy_version() -> str:
    """The installed version of Blender's Python package, which is not imported for this.

    Raises:
        ValueError: it is not installed.
    """
    try:
        return version("bpy")
    except PackageNotFoundError as error:
        raise ValueError("engine blender: not installed; install it with: pip install 'droguekit[blender]'") from error


class BlenderProcess:
    """One Blender.

    Attributes:
        folder: for pictures; in memory where the system has a place for that.
        start_cpu_s: what starting cost. [s]

    Raises:
        ValueError: Blender cannot be loaded here; says what is missing.
    """

    def __init__(self) -> None:
        bpy_version()
        in_memory = _MEMORY_FOLDER.is_dir() and os.access(_MEMORY_FOLDER, os.W_OK)
        self.folder = Path(tempfile.mkdtemp(prefix="droguekit-blender-", dir=_MEMORY_FOLDER if in_memory else None))
        self._log = self.folder / "log.txt"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                # -P: a file that lies where the user works must not stand in for a module of Blender's.
                [sys.executable, "-P", "-m", "render.blender_engine.worker", str(self.folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                # Who kills the engine's whole group would kill it too before it has tidied up; it ends with its input.
                start_new_session=True,
                # The user's own start-up file and add-ons must not change pictures.
                env={**os.environ, "BLENDER_USER_RESOURCES": str(self.folder)},
            )
        self._end = weakref.finalize(self, _end, self._process, self.folder)
        try:
            self.start_cpu_s = self._answer()
        except (BlenderEndedError, ValueError) as error:
            self.close()
            raise ValueError(f"engine blender: cannot be loaded: {error}; droguekit doctor says more") from error

    def ask(self, order: FrameSetup | Picture) -> float:
        """Have an order carried out.

        Returns:
            CPU time that it took. [s]

        Raises:
            BlenderEndedError: the process is gone.
            ValueError: Blender refused.
        """
        assert self._process.stdin is not None
        try:
            pickle.dump(order, self._process.stdin)
            self._process.stdin.flush()
        except OSError as error:
            raise BlenderEndedError(self._last_words()) from error
        return self._answer()

    def close(self) -> None:
        """End the process, in the middle of a picture too, and remove its folder."""
        self._end()

    def _answer(self) -> float:
        assert self._process.stdout is not None
        try:
            answer = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError) as error:
            raise BlenderEndedError(self._last_words()) from error
        if "error" in answer:
            raise ValueError(str(answer["error"]))
        return float(answer["cpu_s"])

    def _last_words(self) -> str:
        try:
            status = self._process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            status = None
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines() if self._log.exists() else []
        return f"the process ended with status {status}" + (f": {lines[-1].strip()}" if lines else "")


def _end(process: subprocess.Popen[bytes], folder: Path) -> None:
    """Close the orders, on which the process ends at once; remove what it may have left."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            try:
                pipe.close()
            except OSError:
                continue  # what was still to be sent has no reader any more
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    shutil.rmtree(folder, ignore_errors=True)
