"""The virtual environment in which ultralytics lives: its own, so that nothing of ours depends on it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from datasets_manifest.atomic import write_text_atomic

# torch as in our own environment. ultralytics is installed without what it asks for: opencv-python needs a display's
# libraries, and torchvision need not even load, see `yolo_script`.
_TORCH = ("torch==2.13.0", "numpy>=1.26,<2", "onnx>=1.17")
_LIGHT = (
    *(
        "opencv-python-headless==4.11.0.86",
        "matplotlib>=3.9",
        "pillow>=10",
        "psutil>=5.9",
        "pyyaml>=6",
        "requests>=2.31",
    ),
    "polars>=1.0",
)
_ALONE = ("ultralytics==8.4.190", "ultralytics-thop==2.2.3", "ultralytics-platform==0.1.99", "torchvision==0.28.0")
_DONE = ".detector-peers"


def peer_python(folder: Path, say: Callable[[str], None]) -> Path:
    """The interpreter of the environment in a folder, which is made where it is missing.

    Args:
        folder: of the environment.
        say: takes a line about what goes on.

    Raises:
        OSError: no environment can be made, or the package index cannot be reached; names the log.
    """
    # Other programs start in folders of their own.
    python = folder.resolve() / "bin" / "python"
    stamp, wanted = folder / _DONE, "\n".join((*_TORCH, *_LIGHT, *_ALONE)) + "\n"
    if stamp.exists() and stamp.read_text(encoding="utf-8") == wanted and python.exists():
        return python
    say(f"installing ultralytics into {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "install.log"
    log.unlink(missing_ok=True)
    _logged(
        [sys.executable, "-m", "venv", str(folder)], log, "no virtual environment can be made; install python3-venv"
    )
    install = [str(python), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    fault = "pip could not install it; is the package index within reach?"
    _logged([*install, *_TORCH, *_LIGHT], log, fault)
    _logged([*install, "--no-deps", *_ALONE], log, fault)
    write_text_atomic(stamp, wanted)
    return python


def peer_variables(folder: Path, threads: int) -> dict[str, str]:
    """Environment variables under which ultralytics stays by itself: no downloads, no settings elsewhere.

    Args:
        folder: gets its settings.
        threads: that it may compute with.
    """
    quiet = {"YOLO_CONFIG_DIR": str(folder.resolve()), "YOLO_AUTOINSTALL": "false", "YOLO_OFFLINE": "true"}
    counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    return {**os.environ, **quiet, **counts, "PYTHONUNBUFFERED": "1"}


def _logged(command: list[str], log: Path, fault: str) -> None:
    with log.open("a", encoding="utf-8") as stream:
        ended = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, check=False)
    if ended.returncode != 0:
        raise OSError(f"{log.parent}: {fault} The whole output is in {log}")
