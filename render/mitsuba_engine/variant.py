"""Which Mitsuba variant works here: on the processor LLVM's when its library does, else the scalar one; or a GPU's.

An unsuitable library or driver can abort the whole process, which nothing can catch: it is tried in a process of its
own. That one works is remembered per library or driver, drjit version and processor. That one does not is forgotten
with the run, as a machine may have been short of memory or time.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import platform
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import make_scratch_folder
from datasets_manifest.user_cache import user_cache_folder
from render.device import Device, kernel_module
from render.engine import EngineUnavailableError
from render.version import RENDER_VERSION

LLVM_REMEDY = "apt-get install libllvm19 (or another one from 17 on)"
"""Debian 12 has 19. Mitsuba 3.9.0 works with 15 too; 3.9.1 aborts the process with 15 and 16."""
_OLDEST_LLVM = 15
_PROBE_TIMEOUT_S = 120
# Libraries that failed in this process or in the one that started it.
_REJECTED = "DROGUEKIT_REJECTED_LLVM"
# By these a user chooses a GPU, or the driver's libraries.
_GPU_CHOICES = ("CUDA_VISIBLE_DEVICES", "DRJIT_LIBCUDA_PATH", "DRJIT_LIBOPTIX_PATH")
_PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 2},
    "emitter": {"type": "constant"}, "shape": {"type": "sphere"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 16, "height": 16}}})
dr.eval(dr.minimum(mi.Float([1.0, 2.0]), 1.5))
import numpy as np
assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
print("works")
"""


@dataclass(frozen=True)
class Variant:
    """The chosen variant and why.

    Attributes:
        variant: its name.
        reason: why this one.
        library: of LLVM, which it uses; None for the other variants.
        gpu: name and driver of the GPU that it uses; None on the processor.
    """

    variant: str
    reason: str
    library: Path | None = None
    gpu: str | None = None


def llvm_libraries() -> list[Path]:
    """LLVM shared libraries to try, the user's own choice (DRJIT_LIBLLVM_PATH) first, then the newest."""
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return [Path(chosen)]
    found: dict[int, Path] = {}
    for folder in (Path("/usr/lib"), *Path("/usr/lib").glob("*-linux-gnu"), *Path("/usr/lib").glob("llvm-*/lib")):
        for path in folder.glob("libLLVM*.so*"):
            match = re.match(r"libLLVM(?:-|\.so\.)(\d+)", path.name)
            if match and int(match.group(1)) >= _OLDEST_LLVM:
                found.setdefault(int(match.group(1)), path.resolve())
    return [found[major] for major in sorted(found, reverse=True)]


def verdicts_file() -> Path:
    """Where it is remembered what works; delete the file to try everything again."""
    return user_cache_folder() / "variant-verdicts.json"


def _works(library: Path) -> bool:
    """Whether the LLVM variant renders with this library, from the cache or by a trial in its own process."""
    try:
        stamp = library.stat().st_mtime_ns
    except OSError:
        return False
    key = "|".join([*_versions(), str(library), str(stamp), platform.processor(), _cpu_model()])
    if _verdicts().get(key) is True:
        return True
    rejected = os.environ.get(_REJECTED, "").splitlines()
    if key in rejected:
        return False
    try:
        trial = _tried(["-c", _PROBE], {"DRJIT_LIBLLVM_PATH": str(library)})
        works = trial.returncode == 0 and b"works" in trial.stdout
    except subprocess.TimeoutExpired:
        works = False
    if works:
        _store_verdict(key, works)
    else:
        # Workers inherit it, so that they take the variant of the process that starts them and try nothing again.
        os.environ[_REJECTED] = "\n".join([*rejected, key])
    return works


def _gpu() -> str:
    """Name and driver of the GPU that Mitsuba renders on, from the cache or by a trial in its own process.

    Only success is remembered: a GPU may be missing or full for a while.

    Raises:
        ValueError: there is none; says what is missing and what to do.
    """
    chosen = (os.environ.get(name, "") for name in _GPU_CHOICES)
    module = kernel_module()
    key = "|".join(["cuda", *_versions(), module, *chosen])
    known = _verdicts().get(key)
    if module and isinstance(known, str):
        return known
    try:
        trial = _tried(["-P", "-m", "render.mitsuba_engine.gpu_trial"], {})
        verdict = json.loads(trial.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        raise ValueError(f"a trial did not end within {_PROBE_TIMEOUT_S} s; look with nvidia-smi") from None
    except (IndexError, ValueError):
        raise ValueError(f"a trial ended with status {trial.returncode}; look for a newer driver") from None
    if "fault" in verdict:
        raise ValueError(verdict["fault"])
    gpu = str(verdict["gpu"])
    _store_verdict(key, gpu)
    return gpu


def _tried(arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[bytes]:
    """Run Python with these arguments.

    Raises:
        subprocess.TimeoutExpired: it takes too long.
    """
    return subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        timeout=_PROBE_TIMEOUT_S,
        check=False,
    )


def _versions() -> tuple[str, str]:
    return version("mitsuba"), version("drjit")


def _verdicts() -> dict[str, Any]:
    """What earlier processes found; empty where that cannot be read."""
    try:
        verdicts = json.loads(verdicts_file().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return verdicts if isinstance(verdicts, dict) else {}


def _store_verdict(key: str, verdict: bool | str) -> None:
    """Keep a verdict for the next process; a cache that cannot be written only costs time."""
    path, verdicts = verdicts_file(), {**_verdicts(), key: verdict}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f"{path.name}.{os.getpid()}")
        part.write_text(json.dumps(verdicts), encoding="utf-8")
        part.replace(path)
    except OSError:
        return


def _cpu_model() -> str:
    try:
        match = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        return platform.machine()
    return match.group(1) if match else platform.machine()


_KERNEL = re.compile(r"[0-9a-f]{32}\.(llvm|cuda|optix)\S*\.bin")
# Of the format that Dr.Jit 1.0 to 1.4 writes: version, then sizes of the compressed contents and of three parts.
_KERNEL_HEADER, _KERNEL_VERSION = "<BIIII", 5
# Written within milliseconds; a process that was killed leaves its file for ever, and nobody writes that kernel again.
_STALE_S = 600.0


def kernel_cache() -> Path:
    """The folder of Dr.Jit's compiled kernels."""
    return Path(os.environ.get("HOME") or "~").expanduser() / ".drjit"


def sweep_kernel_cache(folder: Path) -> None:
    """Remove the kernels that cannot be loaded: empty, truncated, or left half-written; Dr.Jit would keep them."""
    with suppress(OSError):
        with tempfile.TemporaryFile(dir=folder) as stream:
            now_s = os.fstat(stream.fileno()).st_mtime  # by the clock of the disk, which may be another machine's
        for entry in os.scandir(folder):
            with suppress(OSError):
                if _is_spoilt(Path(entry.path), now_s):
                    Path(entry.path).unlink()


@cache
def _sweep_once(folder: Path) -> None:
    """Sweep at this process's first look only: every kernel is opened, of which there may be thousands."""
    sweep_kernel_cache(folder)


def _is_spoilt(path: Path, now_s: float) -> bool:
    if path.name.endswith(".tmp"):
        return now_s - path.stat().st_mtime > _STALE_S
    if not _KERNEL.fullmatch(path.name):
        return False
    with path.open("rb") as stream:
        head, size = stream.read(struct.calcsize(_KERNEL_HEADER)), os.fstat(stream.fileno()).st_size
    if size < struct.calcsize(_KERNEL_HEADER):
        return True
    version, compressed, *_ = struct.unpack(_KERNEL_HEADER, head)
    return bool(version == _KERNEL_VERSION and size != struct.calcsize(_KERNEL_HEADER) + compressed)


def has_kernels(chosen: Variant) -> bool:
    """Whether a process has rendered with this variant before, whose kernels others then load."""
    return chosen.variant == "scalar_rgb" or _stamp(chosen).exists()


def note_kernels(chosen: Variant) -> None:
    """Remember beside the kernels that those of a whole frame are there."""
    with suppress(OSError):
        _stamp(chosen).touch()


def _stamp(chosen: Variant) -> Path:
    parts = (*_versions(), RENDER_VERSION, chosen.variant, str(chosen.library or chosen.gpu), _cpu_model())
    return kernel_cache() / f"droguekit-{hashlib.sha256('|'.join(parts).encode()).hexdigest()[:16]}"


def _provide_home() -> None:
    """Give this process, and those that it starts, a home for Dr.Jit's compiled kernels where the user has none.

    Dr.Jit ends the process where it cannot make the folder `.drjit` in `HOME`.
    """
    home = os.environ.get("HOME")
    try:
        if home:
            (Path(home) / ".drjit").mkdir(exist_ok=True)
            return
    except OSError:
        pass
    folder = make_scratch_folder()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["HOME"] = str(folder)


def probe_variant(device: Device = "cpu") -> Variant:
    """The fastest variant that works on a device of this machine.

    A user whose home cannot be written gets one for the time of this process.

    Raises:
        EngineUnavailableError: Mitsuba is not installed, or there is no such device that it can use.
    """
    try:
        version("mitsuba")
    except PackageNotFoundError as error:
        raise EngineUnavailableError(
            "engine mitsuba: not installed; install it with: pip install 'droguekit[mitsuba]'"
        ) from error
    _provide_home()
    _sweep_once(kernel_cache())
    if device == "cuda":
        try:
            gpu = _gpu()
        except ValueError as error:
            raise EngineUnavailableError(f"device cuda: {error}, or take device cpu") from error
        return Variant("cuda_ad_rgb", f"the GPU works: {gpu}", gpu=gpu)
    libraries = llvm_libraries()
    for library in libraries:
        if _works(library):
            return Variant("llvm_ad_rgb", f"LLVM works: {library}", library)
    tried = ", ".join(str(library) for library in libraries)
    reason = f"no LLVM library works (tried {tried})" if libraries else f"no LLVM library >= {_OLDEST_LLVM} found"
    return Variant("scalar_rgb", f"{reason}; several times slower; {LLVM_REMEDY}")
