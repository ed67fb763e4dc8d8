"""On what and how precisely a training computes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

import cv2
import torch

from nav.training.training_settings import TrainingSettings


@dataclass(frozen=True)
class Computing:
    """A device, and whether most of it is computed in bfloat16 there."""

    device: torch.device
    bf16: bool

    def autocast(self) -> AbstractContextManager[object]:
        """Within it a network computes as precisely as this says."""
        return torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.bf16)


def open_computing(settings: TrainingSettings) -> Computing:
    """The device that the settings name.

    Raises:
        ValueError: it is not there.
    """
    device = torch.device(settings.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError("device: torch sees no CUDA device here; take cpu, or install torch with CUDA")
    if settings.precision != "auto":
        return Computing(device, settings.precision == "bf16")
    # Without such instructions bfloat16 is emulated and slower than float32.
    has_bf16 = torch.cuda.is_bf16_supported() if device.type == "cuda" else torch.cpu._is_avx512_bf16_supported()
    return Computing(device, bool(has_bf16))


@contextmanager
def own_threads(threads: int) -> Iterator[None]:
    """Compute with so many threads meanwhile, all cores that it may use by 0; images are prepared by others."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(threads or len(os.sched_getaffinity(0)))
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])
