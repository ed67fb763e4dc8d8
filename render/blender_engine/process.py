"""The process that runs Blender: started and ended with the engine; takes requests, and returns pictures as arrays."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datasets_manifest.atomic import MEMORY_FOLDER, make_scratch_folder
from render.blender_engine.interpreter import OLDEST_BLENDER, BlenderInterpreter, find_blender
from render.blender_engine.messages import NORMAL_PASS, FrameSetup, ImageWindow, PictureRequest, pickled
from render.device import Device
from render.engine import EngineUnavailableError

_GRACE_S = 5.0
# Blender gives rays that miss a depth of 1e10.
_NOTHING_M = 1e9


class BlenderEndedError(RuntimeError):
    """Blender's process ended by itself."""


class BlenderProcess:
    """A running Blender process.

    Args:
        interpreter: that runs it; by default the one that `find_blender` finds.
        device: that Cycles renders on.

    Attributes:
        folder: for pictures; in memory where the system allows it.
        version: Blender's, such as 5.0.1.
        gpu: name of the GPU that Cycles renders on, None on the processor.
        start_cpu_s: CPU time of its start. [s]

    Raises:
        EngineUnavailableError: Cycles finds no such device.
        ValueError: Blender cannot be loaded; the message says what is missing.
    """

    def __init__(self, interpreter: BlenderInterpreter | None = None, device: Device = "cpu") -> None:
        chosen = find_blender() if interpreter is None else interpreter
        in_memory = MEMORY_FOLDER.is_dir() and os.access(MEMORY_FOLDER, os.W_OK)
        self.folder = make_scratch_folder(MEMORY_FOLDER if in_memory else None)
        self._log = self.folder / "log.txt"
        try:
            self._process, self._answers = _start(chosen, self.folder, self._log, device)
        except (OSError, ValueError) as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise ValueError(f"engine blender: {error}") from error
        self._end = weakref.finalize(self, _end, self._process, self._answers, self.folder)
        try:
            hello = self._read_answer()
        except (BlenderEndedError, ValueError) as error:
            self.close()
            raise ValueError(
                f"engine blender: cannot be loaded by {chosen.path} ({chosen.origin}): {error}; "
                "droguekit doctor says more"
            ) from error
        self.version, self.gpu = str(hello["blender"]), hello["gpu"]
        if device == "cuda" and self.gpu is None:
            self.close()
            raise EngineUnavailableError(
                "device cuda: Blender finds no GPU for OptiX; droguekit doctor says what is missing, or take device cpu"
            )
        self.start_cpu_s = float(hello["cpu_s"])

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
            self._process.stdin.write(pickled(request))
            self._process.stdin.flush()
        except OSError as error:
            raise BlenderEndedError(self._exit_reason()) from error
        return float(self._read_answer()["cpu_s"])

    def close(self) -> None:
        """End the process, even in the middle of a picture, and remove its folder."""
        self._end()

    def _read_answer(self) -> dict[str, Any]:
        try:
            answer: dict[str, Any] = pickle.load(self._answers)
        except (EOFError, pickle.UnpicklingError) as error:
            raise BlenderEndedError(self._exit_reason()) from error
        if "error" in answer:
            raise ValueError(str(answer["error"]))
        return answer

    def _exit_reason(self) -> str:
        try:
            status = self._process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            status = None
        lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines() if self._log.exists() else []
        return f"the process ended with status {status}" + (f": {lines[-1].strip()}" if lines else "")


def _start(
    interpreter: BlenderInterpreter, folder: Path, log: Path, device: Device
) -> tuple[subprocess.Popen[bytes], BinaryIO]:
    """The process and its answers, which have a pipe of their own: Blender prints on its standard output."""
    # The other interpreter must find our modules, and none of the packages that are installed beside them.
    sources = folder / "sources"
    sources.mkdir()
    (sources / "render").symlink_to(Path(__file__).resolve().parents[1])
    answers, write_end = os.pipe()
    code = (
        f"import sys; sys.path.insert(0, {str(sources)!r}); sys.dont_write_bytecode = True; "
        "from render.blender_engine.worker import main; "
        f"main({str(folder)!r}, {write_end}, {OLDEST_BLENDER!r}, {device == 'cuda'})"
    )
    try:
        with log.open("wb") as output:
            process = subprocess.Popen(
                interpreter.command(code),
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=(write_end,),
                # A signal to the engine's process group must not kill it before it cleans up; it ends with its input.
                start_new_session=True,
                # The user's start-up file and add-ons must not change pictures. Blender leaves a folder in TMPDIR.
                env={**os.environ, "BLENDER_USER_RESOURCES": str(folder), "TMPDIR": str(folder)},
            )
    except (OSError, ValueError):
        os.close(answers)
        raise
    finally:
        os.close(write_end)
    return process, os.fdopen(answers, "rb")


def _end(process: subprocess.Popen[bytes], answers: BinaryIO, folder: Path) -> None:
    """Close the process's input, on which it ends at once, and remove its folder."""
    for pipe in (process.stdin, answers):
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
