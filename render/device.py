"""The devices that engines render on, and what NVIDIA's driver tells about a GPU."""

from __future__ import annotations

import os
import subprocess
from typing import Literal

Device = Literal["cpu", "cuda"]
"""The processor, or an NVIDIA GPU by CUDA and OptiX."""
DEVICES: tuple[Device, ...] = ("cpu", "cuda")
_TOOL_TIMEOUT_S = 10.0


def query_gpu(quantity: str) -> float | None:
    """A quantity of the GPU that engines use, as nvidia-smi tells it; None where it does not.

    Args:
        quantity: its name for `nvidia-smi --query-gpu`, such as `memory.free` [MiB] or `power.draw` [W].
    """
    command = ["nvidia-smi", f"--query-gpu={quantity}", "--format=csv,noheader,nounits"]
    # Engines take the first of these, or the first GPU of all.
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[0].strip()
    try:
        told = subprocess.run(
            [*command, "-i", visible or "0"], capture_output=True, text=True, timeout=_TOOL_TIMEOUT_S, check=True
        )
        return float(told.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
