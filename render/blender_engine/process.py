"""The process that runs Blender: started and ended with the engine; takes requests, and returns pictures as arrays."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import weakref
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from render.blender_engine.messages import NORMAL_PASS, FrameSetup, ImageWindow, PictureRequest

_MEMORY_FOLDER = Path("/dev/shm")
_GRACE_S = 5.0
# Blender gives rays that miss a depth of 1e10.
_NOTHING_M = 1e9


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
    """A running Blender process.

    Attributes:
        folder: for pictures; in memory where the system allows it.
        start_cpu_s: CPU time of its start. [s]

    Raises:
        ValueError: Blender cannot be loaded; the message says what is missing.
    """

    def __init__(self) -> None:
        bpy_version()
        in_memory = _MEMORY_FOLDER.is_dir() and os.access(_MEMORY_FOLDER, os.W_OK)
        self.folder = Path(tempfile.mkdtemp(prefix="droguekit-blender-", dir=_MEMORY_FOLDER if in_memory else None))
        self._log = self.folder / "log.txt"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                # -P: a file in the working folder must not replace one of Blender's modules.
                [sys.executable, "-P", "-m", "render.blender_engine.worker", str(self.folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                # A signal to the engine's process group must not kill it before it cleans up; it ends with its input.
                start_new_session=True,
                # The user's start-up file and add-ons must not change pictures.
                env={**os.environ, "BLENDER_USER_RESOURCES": str(self.folder)},
            )
        self._end = weakref.finalize(self, _end, self._process, self.folder)
        try:
            self.start_cpu_s = self._read_answer()
        except (BlenderEndedError, ValueError) as error:
            self.close()
            raise ValueError(f"engine blender: cannot be loaded: {error}; droguekit doctor says more") from error

    def ask(self, request: FrameSetup | PictureRequest) -> float:
        """Send a request and wait until it is done.

        Returns:
            Its CPU time. [s]

        Raises:
            BlenderEndedError: the process has ended.
            ValueError: Blender reported an error.
        """
        assert self._process.stdin is not None
        try:
            pickle.dump(request, self._process.stdin)
            self._process.stdin.flush()
        except OSError as error:
            raise BlenderEndedError(self._exit_reason()) from error
        return self._read_answer()

    def close(self) -> None:
        """End the process, even in the middle of a picture, and remove its folder."""
        self._end()

    def _read_answer(self) -> float:
        assert self._process.stdout is not None
        try:
            answer = pickle.load(self._process.stdout)
        except (EOFError, pickle.UnpicklingError) as error:
            raise BlenderEndedError(self._exit_reason()) from error
        if "error" in answer:
            raise ValueError(str(answer["error"]))
        return float(answer["cpu_s"])

    def _exit_reason(self) -> str:
        try:
            status = self._process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            status = None
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines() if self._log.exists() else []
        return f"the process ended with status {status}" + (f": {lines[-1].strip()}" if lines else "")


def _end(process: subprocess.Popen[bytes], folder: Path) -> None:
    """Close the process's input, on which it ends at once, and remove its folder."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            try:
                pipe.close()
            except OSError:
                continue  # unsent data has no reader any more
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    shutil.rmtree(folder, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class CenterPixels:
    """What the rays through the pixel centres of a window hit.

    Attributes:
        part_id: (h, w) uint8, 0 for nothing.
        depth_m: (h, w) planar depth, inf for nothing. [m]
        normal: (h, w, 3) of the face, in the stage's axes.
    """

    part_id: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    normal: NDArray[np.float32]


def _channels(path: Path) -> dict[str, NDArray[np.float32]]:
    """All channels of all parts by their names, without the layer's."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found: dict[str, Any] = {}
        for part in file.parts:
            found |= {name.split(".", 1)[-1]: channel.pixels for name, channel in part.channels.items()}
    return found


def read_light(path: Path) -> NDArray[np.float32]:
    """(h, w, 4) light weighted by coverage, and coverage."""
    found = _channels(path)
    return np.stack([found[f"Combined.{channel}"] for channel in "RGBA"], axis=-1)


def read_passes(path: Path) -> CenterPixels:
    """Part ids, depth and normals."""
    found = _channels(path)
    part_id = np.rint(found["Object Index.X"]).astype(np.uint8)
    depth = found["Depth.Z"]
    normal = np.stack([found[f"{NORMAL_PASS}.{axis}"] for axis in "RGB"], axis=-1)
    return CenterPixels(
        part_id=part_id,
        depth_m=np.where(depth < _NOTHING_M, depth, np.inf).astype(np.float32),
        normal=normal,
    )


def paste(whole: NDArray[Any], window: ImageWindow, values: NDArray[Any]) -> None:
    """Write a window's pixels into the whole image, in place."""
    rows = slice(window.top_px, window.top_px + window.height_px)
    columns = slice(window.left_px, window.left_px + window.width_px)
    whole[rows, columns] = values
