"""Who renders frames, and where: worker processes, as many as this machine can run, or a Dask scheduler."""

from __future__ import annotations

import ctypes
import gc
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from render.device import Device, query_gpu

# A worker that has the engine loaded and renders a 1280 x 960 pair stays below this.
GIB_PER_WORKER = 1.5
# Of a GPU's memory: driver and OptiX, and 300 bytes for each lane of the largest launch. An estimate.
_GPU_GIB_PER_WORKER = 2.0
_GROUP = Path("/sys/fs/cgroup")


@dataclass(frozen=True)
class ExecutionOptions:
    """Who renders frames, and how long each may take.

    Attributes:
        workers: processes of this machine; 0 runs in this process, for debugging; None means as many as cores and
            memory allow.
        timeout_s: for one frame; None computes it from the recipe. [s]
        scheduler: address of a Dask scheduler whose workers make the frames instead, or None.
        pairs_per_tar: how many frames come into a tar file; None keeps what the dataset has, folders at first.
        device: that the engine renders on.

    Raises:
        ValueError: a time limit in this process, which could not be stopped.
    """

    workers: int | None = None
    timeout_s: float | None = None
    scheduler: str | None = None
    pairs_per_tar: int | None = None
    device: Device = "cpu"

    def __post_init__(self) -> None:
        if self.workers == 0 and self.scheduler is None and self.timeout_s is not None:
            raise ValueError("--timeout: --workers 0 renders in this process, which sets no limit; leave one out")

    def worker_count(self) -> int:
        """`workers`, or the default of this machine where it is None."""
        return default_workers(self.device) if self.workers is None else self.workers

    def with_workers(self) -> Self:
        """The same with the number of workers filled in."""
        return replace(self, workers=self.worker_count())


def available_cores(group: Path = _GROUP) -> int:
    """Cores that this process may use, by its affinity and by its container's quota.

    Args:
        group: folder of the control group.
    """
    cores = len(os.sched_getaffinity(0))
    try:
        quota, period = (group / "cpu.max").read_text(encoding="ascii").split()
        return cores if quota == "max" else max(1, min(cores, int(quota) // int(period)))
    except (OSError, ValueError):
        return cores  # no container limit is in force


def available_memory_gib(group: Path = _GROUP) -> float:
    """Memory that is free for new processes, as the kernel and the container's limit tell. [GiB]

    Args:
        group: folder of the control group.
    """
    free = [_number_after("MemAvailable:", Path("/proc/meminfo")) * 1024]
    try:
        limit = (group / "memory.max").read_text(encoding="ascii").strip()
        if limit != "max":
            used = int((group / "memory.current").read_text(encoding="ascii"))
            # Cached files count as used, but are evicted when memory is needed.
            free.append(int(limit) - used + _number_after("inactive_file", group / "memory.stat"))
    except (OSError, ValueError):
        pass  # no container limit is in force
    return max(0.0, min(free) / 2**30)


def default_workers(device: Device = "cpu") -> int:
    """As many workers as cores and memory allow; and the memory of the GPU, where they share one."""
    most = min(available_cores(), int(available_memory_gib() / GIB_PER_WORKER))
    free_mib = query_gpu("memory.free") if device == "cuda" else None
    if free_mib is not None:
        most = min(most, int(free_mib / 1024 / _GPU_GIB_PER_WORKER))
    return max(1, most)


def resident_gib() -> float:
    """Memory that this process holds now. [GiB]"""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**30


def return_free_memory() -> None:
    """Give the kernel what no live object needs: half of a renderer's memory.

    These are objects that refer to each other in circles, such as the meshes of trimesh, which Python looks for rarely;
    and the free memory between live objects, which the C library keeps.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc has it, other libraries have not
    if trim is not None:
        trim(0)


def _number_after(name: str, path: Path) -> float:
    for line in path.read_text(encoding="ascii").splitlines():
        words = line.split()
        if words[0] == name:
            return float(words[1])
    raise ValueError(f"{path}: names no {name}")
