"""How much memory and time each reader takes for the worst files.

`python -m tests.support.peak_memory FOLDER NAME...` reads them in processes of their own and prints a line of JSON for
each.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import onnx
import torch

from tests.support.bombs import BOMBS

# A reader that takes more of the processor's time, or waits for ever, is ended.
_MOST_CPU_S, _LONGEST_S = 60, 600


def _status_bytes(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


def _in_child(action: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a function returns in a process of its own."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(_LONGEST_S)
        resource.setrlimit(resource.RLIMIT_CPU, (_MOST_CPU_S, _MOST_CPU_S))
        found: dict[str, Any] = {"fault": "ended"}
        try:
            found = action()
        except BaseException as error:
            found = {"fault": f"{type(error).__name__}: {error}"[:500]}
        finally:
            os.write(writing, json.dumps(found).encode())
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as stream:
        data = stream.read()
    _, status = os.waitpid(child, 0)
    return json.loads(data) if data else {"fault": f"ended with status {status}"}


def measure(name: str, folder: Path) -> dict[str, Any]:
    """How much more memory than before a reader takes for a bomb, and how it ends."""

    def write() -> dict[str, Any]:
        place = folder / name.replace(" ", "-")
        place.mkdir()
        path = BOMBS[name].write(place)
        sizes = [file.stat().st_size for file in ([path] if path.is_file() else path.rglob("*")) if file.is_file()]
        return {"path": str(path), "most_bytes": max(sizes)}

    def read() -> dict[str, Any]:
        Path("/proc/self/clear_refs").write_text("5")  # the peak becomes what is held now
        before, start_s, told = _status_bytes("VmRSS"), time.process_time(), "read"
        try:
            BOMBS[name].read(Path(written["path"]))
        except (ValueError, OSError) as error:
            told = str(error)
        return {
            "peak_bytes": _status_bytes("VmHWM") - before,
            "cpu_s": round(time.process_time() - start_s, 2),
            "told": told[:2000],
            "lines": told.strip().count("\n") + 1,
        }

    written = _in_child(write)
    if "fault" in written:
        return {"name": name, **written}
    found = {"name": name, "most_bytes": written["most_bytes"], **_in_child(read)}
    shutil.rmtree(folder / name.replace(" ", "-"))
    return found


if __name__ == "__main__":
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    assert onnx.__version__
    for each in sys.argv[2:] or BOMBS:
        print(json.dumps(measure(each, Path(sys.argv[1]))), flush=True)
