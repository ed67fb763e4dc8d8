"""Blender's own process: reads requests from its standard input until that closes.

Importing `bpy` changes `sys.path` and puts the process under Blender's licence; so it runs nothing else.
"""

from __future__ import annotations

import os
import pickle
import queue
import shutil
import signal
import sys
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


def main() -> None:
    """Serve one engine. Its argument is the folder that is removed at the end."""
    folder = Path(sys.argv[1])
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    # Blender prints on standard output, which is redirected to standard error.
    os.dup2(2, 1)
    _ignore_signals()
    inbox: queue.SimpleQueue[FrameSetup | PictureRequest] = queue.SimpleQueue()
    threading.Thread(target=_read_requests, args=(requests, inbox, folder), daemon=True).start()
    try:
        from render.blender_engine.blender_scene import BlenderScene, render_picture
    except ImportError as error:
        _answer(answers, {"error": str(error)})
        return
    _ignore_signals()
    scene = BlenderScene()
    _answer(answers, {"cpu_s": time.process_time()})
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


if __name__ == "__main__":
    main()
