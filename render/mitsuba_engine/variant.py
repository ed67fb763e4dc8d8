"""Which Mitsuba variant works here: the LLVM one when its library does, else the scalar one.

An unsuitable LLVM library can abort the whole process, which nothing can catch: it is tried in a process of its own,
and the verdict is remembered per library, drjit version and processor.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_OLDEST_LLVM = 15
_PROBE_TIMEOUT_S = 120
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
    """The chosen variant, why, and the LLVM library that it uses (None for the scalar variant)."""

    variant: str
    reason: str
    library: Path | None


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


def _cache_file() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "droguekit" / "llvm-verdicts.json"


def _works(library: Path) -> bool:
    """Whether the LLVM variant renders with this library, from the cache or by a trial in its own process."""
    try:
        stamp = library.stat().st_mtime_ns
    except OSError:
        return False
    key = "|".join([version("mitsuba"), version("drjit"), str(library), str(stamp), platform.processor(), _cpu_model()])
    verdicts: dict[str, bool] = {}
    try:
        verdicts = json.loads(_cache_file().read_text(encoding="utf-8"))
        if isinstance(verdicts.get(key), bool):
            return verdicts[key]
    except (OSError, ValueError, AttributeError):
        verdicts = {}
    try:
        trial = subprocess.run(
            [sys.executable, "-c", _PROBE],
            env={**os.environ, "DRJIT_LIBLLVM_PATH": str(library)},
            capture_output=True,
            timeout=_PROBE_TIMEOUT_S,
            check=False,
        )
        works = trial.returncode == 0 and b"works" in trial.stdout
    except subprocess.TimeoutExpired:
        works = False
    _store_verdicts({**verdicts, key: works})
    return works


def _store_verdicts(verdicts: dict[str, bool]) -> None:
    """Keep the verdicts for the next process; a cache that cannot be written only costs time."""
    path = _cache_file()
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


def probe_variant() -> Variant:
    """The fastest variant that works on this machine.

    Raises:
        ValueError: Mitsuba is not installed.
    """
    try:
        version("mitsuba")
    except PackageNotFoundError as error:
        raise ValueError("engine mitsuba: not installed; install it with: pip install 'droguekit[mitsuba]'") from error
    libraries = llvm_libraries()
    for library in libraries:
        if _works(library):
            return Variant("llvm_ad_rgb", f"LLVM works: {library}", library)
    tried = ", ".join(str(library) for library in libraries)
    reason = f"no LLVM library works (tried {tried})" if libraries else f"no LLVM library >= {_OLDEST_LLVM} found"
    return Variant("scalar_rgb", f"{reason}; about 3 times slower", None)
