"""The devices that engines render on, and what NVIDIA's driver tells about a GPU."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from typing import Literal

Device = Literal["cpu", "cuda"]
"""The processor, or an NVIDIA GPU by CUDA and OptiX."""
DEVICES: tuple[Device, ...] = ("cpu", "cuda")
_KERNEL_MODULE = Path("/proc/driver/nvidia/version")
_TOOL_TIMEOUT_S = 10.0


def kernel_module() -> str:
    """What the driver's kernel module says of itself; empty where there is none."""
    try:
        return _KERNEL_MODULE.read_text(encoding="utf-8")
    except OSError:
        return ""


def driver_version() -> str | None:
    """Version of NVIDIA's driver, such as 550.54.14; None where it is not known."""
    found = re.search(r"Module.*?\s(\d+(?:\.\d+)+)", kernel_module())
    return None if found is None else found.group(1)


def query_gpu(quantity: str) -> float | None:
    """A quantity of the GPU that engines use, as nvidia-smi tells it; None where it does not.

    Args:
        quantity: its name for `nvidia-smi --query-gpu`, such as `memory.free` [MiB] or `power.draw` [W].
    """
    try:
        return float(_told_of_gpu(quantity) or "")
    except ValueError:
        return None


def gpu_model() -> str | None:
    """Model of the GPU that engines use, such as `NVIDIA H100 80GB HBM3`; None where nvidia-smi does not tell it."""
    return _told_of_gpu("name")


def _told_of_gpu(quantity: str) -> str | None:
    command = ["nvidia-smi", f"--query-gpu={quantity}", "--format=csv,noheader,nounits"]
    # Engines take the first of these, or the first GPU of all.
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[0].strip()
    try:
        told = subprocess.run(
            [*command, "-i", visible or "0"], capture_output=True, text=True, timeout=_TOOL_TIMEOUT_S, check=True
        )
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return told.stdout.strip() or None
