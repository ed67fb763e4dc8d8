"""The virtual environment of the peers, and the scripts that run in it.

It is separate so that nothing of ours depends on ultralytics or libreyolo.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import write_text_atomic

# torch as in our own environment. ultralytics and libreyolo are installed without their dependencies: opencv-python
# would need the libraries of a display, and torchvision need not even load, see the scripts.
_TORCH = ("torch==2.13.0", "numpy>=1.26,<2", "onnx>=1.17")
_LIGHT = (
    "opencv-python-headless==4.11.0.86",
    "matplotlib>=3.9",
    "onnxsim==0.8.1",
    "pillow>=10",
    "polars>=1.0",
    "psutil>=5.9",
    "pycocotools>=2.0",
    "pyyaml>=6",
    "requests>=2.31",
    "safetensors>=0.4",
    "scipy>=1.16",
    "tqdm>=4.65",
    "typer>=0.9",
)
_WITHOUT_DEPENDENCIES = (
    "libreyolo==1.6.0",
    "ultralytics==8.4.190",
    "ultralytics-thop==2.2.3",
    "ultralytics-platform==0.1.99",
    "torchvision==0.28.0",
)
_DONE = ".detector-peers"


def peer_python(folder: Path, say: Callable[[str], None]) -> Path:
    """The Python interpreter of the environment in a folder; the environment is made if it is missing.

    Args:
        folder: of the environment.
        say: receives lines about the progress.

    Raises:
        OSError: no environment can be made, or the package index cannot be reached; the message names the log.
    """
    # Absolute, because other programs start in other folders.
    python = folder.resolve() / "bin" / "python"
    stamp, wanted = folder / _DONE, "\n".join((*_TORCH, *_LIGHT, *_WITHOUT_DEPENDENCIES)) + "\n"
    if stamp.exists() and stamp.read_text(encoding="utf-8") == wanted and python.exists():
        return python
    say(f"installing ultralytics and libreyolo into {folder}")
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "install.log"
    log.unlink(missing_ok=True)
    _run_logged(
        [sys.executable, "-m", "venv", str(folder)], log, "no virtual environment can be made; install python3-venv"
    )
    install = [str(python), "-m", "pip", "install", "--no-input", "--disable-pip-version-check"]
    fault = "pip could not install them; is the package index within reach?"
    _run_logged([*install, *_TORCH, *_LIGHT], log, fault)
    _run_logged([*install, "--no-deps", *_WITHOUT_DEPENDENCIES], log, fault)
    write_text_atomic(stamp, wanted)
    return python


def script_variables(folder: Path, threads: int) -> dict[str, str]:
    """Environment variables that keep ultralytics from downloading, and from writing settings elsewhere.

    Args:
        folder: for its settings.
        threads: number of threads that a script may use.
    """
    quiet = {"YOLO_CONFIG_DIR": str(folder.resolve()), "YOLO_AUTOINSTALL": "false", "YOLO_OFFLINE": "true"}
    counts = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(threads))
    return {**os.environ, **quiet, **counts, "PYTHONUNBUFFERED": "1"}


def _run_logged(command: list[str], log: Path, fault: str) -> None:
    with log.open("a", encoding="utf-8") as stream:
        ended = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, check=False)
    if ended.returncode != 0:
        raise OSError(f"{log.parent}: {fault} The whole output is in {log}")


def run_script(python: Path, script: Path, task: Mapping[str, Any], log: Path, variables: Mapping[str, str]) -> None:
    """Run a task of a script in the peers' environment, with its output in a log.

    Raises:
        OSError: it failed; the message has the last line of the output, and names the log.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a", encoding="utf-8") as stream:
        ended = subprocess.run(
            # -P: a file in the working folder must not replace a module of the script.
            [str(python), "-P", str(script)],
            input=json.dumps(task),
            text=True,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=dict(variables),
            cwd=log.parent,
            check=False,
        )
    if ended.returncode != 0:
        lines = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
        raise OSError(
            f"{log}: {script.stem} ended with status {ended.returncode}: {lines[-1] if lines else 'silently'}"
        )
