"""Blender's own process: reads requests from its standard input until that closes.

Importing `bpy` changes `sys.path` and puts the process under Blender's licence; so it runs nothing else. It may run on
another Python than the engine: this module and what it imports need `bpy`, numpy and the standard library alone.
"""

from __future__ import annotations

import os
import pickle
import queue
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any, BinaryIO

from render.blender_engine.messages import FrameSetup, PictureRequest


def _read_requests(requests: BinaryIO, inbox: queue.SimpleQueue[FrameSetup | PictureRequest], folder: Path) -> None:
    """Pass requests on; when the engine is gone, end at once, even in the middle of a picture."""
    try:
        while True:
            inbox.put(pickle.load(requests))
    except (EOFError, pickle.UnpicklingError, OSError):
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)


def main(folder_name: str, answers_fd: int, oldest_blender: str, on_gpu: bool) -> None:
    """Serve one engine.

    Args:
        folder_name: of the folder that is removed at the end.
        answers_fd: file descriptor to answer on.
        oldest_blender: version that has all that the pictures need.
        on_gpu: whether to render on a GPU; where there is none, the first answer says so.
    """
    folder = Path(folder_name)
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(answers_fd, "wb")
    _ignore_signals()
    inbox: queue.SimpleQueue[FrameSetup | PictureRequest] = queue.SimpleQueue()
    threading.Thread(target=_read_requests, args=(requests, inbox, folder), daemon=True).start()
    try:
        found = _blender_version(oldest_blender)
        from render.blender_engine.blender_scene import BlenderScene, choose_gpu, render_picture
    except ImportError as error:
        _answer(answers, {"error": str(error)})
        return
    _ignore_signals()
    scene = BlenderScene()
    gpu = choose_gpu() if on_gpu else None
    if gpu is not None:
        scene.device = "GPU"
    _answer(answers, {"cpu_s": time.process_time(), "blender": found, "gpu": gpu})
    while True:
        request, started = inbox.get(), time.process_time()
        try:
            if isinstance(request, FrameSetup):
                scene.set_frame(request)
            else:
                render_picture(scene, request)
        except Exception as error:
            _answer(answers, {"error": f"{type(error).__name__}: {error}"})
            continue
        _answer(answers, {"cpu_s": time.process_time() - started})


def _blender_version(oldest: str) -> str:
    """This Blender's version.

    Raises:
        ImportError: there is no Blender, or one that is too old.
    """
    import bpy

    version: tuple[int, ...] = bpy.app.version
    found = ".".join(map(str, version))
    if version < tuple(map(int, oldest.split("."))):
        raise ImportError(f"this is Blender {found}, and {oldest} or newer is needed")
    return found


def _ignore_signals() -> None:
    """Ignore SIGINT and SIGTERM, so that the engine decides when this process ends.

    A scheduler may signal every process of a job; this one outlives the engine just long enough to clean up. Blender
    sets handlers of its own when it is imported.
    """
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, signal.SIG_IGN)


def _answer(answers: BinaryIO, content: dict[str, Any]) -> None:
    pickle.dump(content, answers)
    answers.flush()
