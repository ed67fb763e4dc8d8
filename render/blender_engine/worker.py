"""Blender's own process: takes orders from its standard input until that closes.

Importing `bpy` changes `sys.path` and ties the process to Blender's licence; nothing else of ours lives here.
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

from render.blender_engine.messages import FrameSetup, Picture


def _read_orders(orders: BinaryIO, inbox: queue.SimpleQueue[FrameSetup | Picture], folder: Path) -> None:
    """Pass orders on; when the engine is gone, end at once, in the middle of a picture too."""
    try:
        while True:
            inbox.put(pickle.load(orders))
    except (EOFError, pickle.UnpicklingError, OSError):
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(0)


def main() -> None:
    """Serve one engine. Argument: the folder that is removed at the end."""
    folder = Path(sys.argv[1])
    orders = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    # Blender talks on standard output; what it says goes where errors go.
    os.dup2(2, 1)
    _leave_ending_to_the_engine()
    inbox: queue.SimpleQueue[FrameSetup | Picture] = queue.SimpleQueue()
    threading.Thread(target=_read_orders, args=(orders, inbox, folder), daemon=True).start()
    try:
        from render.blender_engine.blender_pictures import take_picture
        from render.blender_engine.blender_scene import BlenderScene
    except ImportError as error:
        _answer(answers, {"error": str(error)})
        return
    _leave_ending_to_the_engine()
    scene = BlenderScene()
    _answer(answers, {"cpu_s": time.process_time()})
    while True:
        order, started = inbox.get(), time.process_time()
        try:
            if isinstance(order, FrameSetup):
                scene.set_frame(order)
            else:
                take_picture(scene, order)
        except Exception as error:
            _answer(answers, {"error": f"{type(error).__name__}: {error}"})
            continue
        _answer(answers, {"cpu_s": time.process_time() - started})


def _leave_ending_to_the_engine() -> None:
    """A scheduler may signal every process of a job; this one outlives the engine just long enough to tidy up.

    Blender sets handlers of its own when it is imported.
    """
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, signal.SIG_IGN)


def _answer(answers: BinaryIO, content: dict[str, Any]) -> None:
    pickle.dump(content, answers)
    answers.flush()


if __name__ == "__main__":
    main()
