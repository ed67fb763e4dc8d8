"""Tries whether Mitsuba renders on a GPU here: `python -m render.mitsuba_engine.gpu_trial` prints the verdict as JSON.

It is run in a process of its own, because an unsuitable driver can end the whole process.
"""

from __future__ import annotations

import ctypes
import json
import os

from render.device import driver_version

OLDEST_DRIVER = 535
"""Of NVIDIA's driver, for the OptiX that Mitsuba calls."""
# Dr.Jit passes over older GPUs.
_LEAST_CAPABILITY = (7, 5)
# CUdevice_attribute of cuda.h.
_CAPABILITY_ATTRIBUTES = (75, 76)


def main() -> None:
    """Print `{"gpu": name and driver}`, or `{"fault": what is missing and what to do}`."""
    try:
        _render_sphere()
        verdict = {"gpu": gpu_name()}
    except Exception as error:  # foreign libraries may fail in any way
        verdict = {"fault": find_fault() or f"{' '.join(str(error).split())}; look for a newer driver"}
    print(json.dumps(verdict))


def _render_sphere() -> None:
    import mitsuba as mi
    import numpy as np

    mi.set_variant("cuda_ad_rgb")
    sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 16, "height": 16}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "emitter": {"type": "constant"},
            "shape": {"type": "sphere"},
            "sensor": sensor,
        }
    )
    if not np.isfinite(np.array(mi.render(scene, spp=1))).all():
        raise ValueError("a picture of a sphere is not finite")


def find_fault() -> str | None:
    """What the driver lacks for rendering, and what to do; None where nothing is found."""
    try:
        cuda = _cuda()
    except OSError:
        return f"no NVIDIA driver, as {_cuda_library()} cannot be loaded; install driver {OLDEST_DRIVER} or newer"
    code = cuda.cuInit(0)
    if code == 100 or (code == 0 and _integer(cuda.cuDeviceGetCount) == 0):
        return "NVIDIA's driver finds no GPU; look with nvidia-smi, and whether CUDA_VISIBLE_DEVICES hides it"
    if code != 0:
        return f"NVIDIA's driver does not start (CUDA error {code}); look with nvidia-smi"
    capability = tuple(_integer(cuda.cuDeviceGetAttribute, attribute, 0) for attribute in _CAPABILITY_ATTRIBUTES)
    if capability < _LEAST_CAPABILITY:
        least = _dotted(_LEAST_CAPABILITY)
        return f"{gpu_name()} has compute capability {_dotted(capability)} and Mitsuba needs {least}; take a newer GPU"
    optix = os.environ.get("DRJIT_LIBOPTIX_PATH") or "libnvoptix.so.1"
    try:
        ctypes.CDLL(optix)
    except OSError:
        return (
            f"OptiX is missing, as {optix} cannot be loaded; install all of driver {OLDEST_DRIVER} or newer, give a "
            "container NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics"
        )
    return None


def gpu_name() -> str:
    """Name of the first GPU, and the driver's version.

    Raises:
        OSError: there is no driver.
    """
    cuda = _cuda()
    cuda.cuInit(0)
    name = ctypes.create_string_buffer(256)
    cuda.cuDeviceGetName(name, len(name), 0)
    driver, version = driver_version(), _integer(cuda.cuDriverGetVersion)
    of_driver = f"driver {driver}" if driver else f"CUDA {version // 1000}.{version % 1000 // 10}"
    return f"{name.value.decode(errors='replace')}, {of_driver}"


def _cuda() -> ctypes.CDLL:
    return ctypes.CDLL(_cuda_library())


def _cuda_library() -> str:
    return os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1"


def _integer(function: ctypes._NamedFuncPointer, *arguments: int) -> int:
    """The number that a function of the driver writes."""
    value = ctypes.c_int()
    function(ctypes.byref(value), *arguments)
    return value.value


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


if __name__ == "__main__":
    main()
