"""What is installed here, which engines work, and what is missing; makes an environment with Blender where asked."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

from render.blender_engine.interpreter import VARIABLE, blender_environment, environment_python

_PACKAGES = (
    "numpy",
    "scipy",
    "opencv-python-headless",
    "OpenEXR",
    "pydantic",
    "pycocotools",
    "trimesh",
    "matplotlib",
    "typer",
    "mitsuba",
    "drjit",
    "bpy",
    "rerun-sdk",
)
# What Blender's Python package loads from the system, and Debian's packages of them.
_BLENDER_LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libXfixes.so.3": "libxfixes3",
    "libXi.so.6": "libxi6",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libGL.so.1": "libgl1",
}
_LIBATOMIC = ("libatomic.so.1", "apt-get install libatomic1")


def installation_lines() -> Generator[str, None, bool]:
    """Look at machine, packages, optional programs and engines.

    Returns:
        Whether the path tracer works; labels, navigation and benchmark work without any.
    """
    yield from _machine_lines()
    yield from _package_lines()
    yield from _viewer_lines()
    yield from _video_lines()
    yield from _browser_lines()
    return (yield from engine_lines())


def _machine_lines() -> Iterator[str]:
    from datasets_manifest.storage.manifest import cpu_features
    from droguekit.batch.execution import available_cores, available_memory_gib, default_workers

    yield f"python     {platform.python_version()}, {sys.executable}"
    yield f"system     {platform.platform()}"
    yield f"processor  {available_cores()} of {os.cpu_count()} cores; {' '.join(cpu_features())}"
    yield f"memory     {available_memory_gib():.1f} GiB free: {default_workers()} workers by default"


def _package_lines() -> Iterator[str]:
    from importlib.metadata import PackageNotFoundError, version

    for package in ("droguekit", *_PACKAGES):
        try:
            found = version(package)
        except PackageNotFoundError:
            found = "missing"
        yield f"package    {package} {found}"


def _viewer_lines() -> Iterator[str]:
    """Load the rerun viewer's library, which only `view` needs."""
    try:
        import rerun
    except ImportError as error:
        yield f"viewer     rerun is optional: {error}; pip install 'droguekit[viz]'"
        return
    yield f"viewer     rerun {rerun.__version__}, for droguekit view"


def _video_lines() -> Iterator[str]:
    """Load the package that reads cameras and writes MP4, for `navigate --live` and videos of `preview`."""
    try:
        import av
    except ImportError as error:
        yield f"video      PyAV is optional: {error}; pip install 'droguekit[video]'"
        return
    yield f"video      PyAV {av.__version__}, for droguekit navigate --live and MP4 files of droguekit preview"


def _browser_lines() -> Iterator[str]:
    """Look for a browser, which only the PDF of `report` needs."""
    from droguekit.visualization.print_pdf import NO_BROWSER, find_browser

    found = find_browser()
    if found is None:
        yield f"browser    Chromium is optional: {NO_BROWSER}"
        return
    yield f"browser    {found}, for droguekit report --pdf"


def engine_lines() -> Generator[str, None, bool]:
    """Try each engine.

    Returns:
        Whether Mitsuba works; the analytic engine needs nothing.
    """
    from render.mitsuba_engine.variant import kernel_cache, probe_variant, verdicts_file

    yield "engine     analytic works: flat discs without path tracing, for estimators"
    yield from _blender_lines()
    missing = _missing_libraries()
    for name, remedy in missing:
        yield f"library    {name} is missing; {remedy}"
    try:
        variant = probe_variant()
    except ValueError as error:
        yield f"engine     mitsuba does not work: {error}"
        return False
    if _LIBATOMIC in missing:
        yield "engine     mitsuba does not work without libatomic.so.1"
        return False
    yield f"engine     mitsuba works as {variant.variant}: {variant.reason}"
    yield f"cache      {verdicts_file()} remembers which LLVM works, {kernel_cache()} holds compiled kernels"
    try:
        yield f"gpu        works, for --device cuda: {probe_variant('cuda').gpu}"
    except ValueError as error:
        yield f"gpu        is optional: {error}"
    return True


def _blender_lines() -> Iterator[str]:
    """Start Blender, which only its own engine needs."""
    from render.blender_engine.interpreter import find_blender
    from render.blender_engine.process import BlenderProcess

    try:
        chosen = find_blender()
    except ValueError as error:
        yield f"engine     blender is optional: {error}"
        return
    try:
        process = BlenderProcess(chosen)
    except ValueError as error:
        missing = [package for library, package in _BLENDER_LIBRARIES.items() if not _loads(library)]
        reason = f"apt-get install {' '.join(missing)}" if missing else str(error)
        yield f"engine     blender does not work: {reason}"
        return
    process.close()
    yield f"engine     blender works: {process.version}, Cycles on the CPU, by {chosen.path} ({chosen.origin})"


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _missing_libraries() -> list[tuple[str, str]]:
    """System libraries that Mitsuba asks for and that are not here, each with what to do."""
    from render.mitsuba_engine.variant import LLVM_REMEDY, llvm_libraries

    missing = []
    if not _loads(_LIBATOMIC[0]):
        missing.append(_LIBATOMIC)
    if not any(library.exists() for library in llvm_libraries()):
        missing.append(("LLVM >= 15", f"{LLVM_REMEDY}, or name one in DRJIT_LIBLLVM_PATH"))
    return missing


BPY_OF_PYTHON = {"3.13": "bpy==5.2.3", "3.11": "bpy==5.0.1"}
"""Blender's package by the Python that it has a wheel for, the newest first."""


def make_blender() -> Iterator[str]:
    """Make the environment anew, from a Python that is here or that uv fetches.

    Yields:
        What is being done.

    Raises:
        ValueError: no fitting Python is here, or the package cannot be installed.
        OSError: the environment's folder cannot be written.
    """
    folder = blender_environment()
    part = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.parent.mkdir(parents=True, exist_ok=True)
    try:
        python = _fitting_python()
        if python is not None:
            version, program = python
            yield f"blender    making {folder} with Python {version}, {program}"
            _run([program, "-m", "venv", "--without-pip", str(part)], "the virtual environment cannot be made")
        elif (uv := shutil.which("uv")) is not None:
            version = next(iter(BPY_OF_PYTHON))
            yield f"blender    making {folder} with Python {version} from uv"
            _run([uv, "venv", "--python", version, str(part)], f"uv has no Python {version} here")
        else:
            raise ValueError(
                f"doctor: Blender's package needs Python {' or '.join(BPY_OF_PYTHON)}, and neither is here, nor uv to "
                f"fetch one; install one of them, or name a Blender program in {VARIABLE}"
            )
        package = BPY_OF_PYTHON[version]
        yield f"blender    installing {package} (350 MB)"
        _run([*_installer(environment_python(part)), package], f"{package} cannot be installed")
        shutil.rmtree(folder, ignore_errors=True)
        # Finished environments alone have this name. What is moved are links and packages, which no path holds.
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _fitting_python() -> tuple[str, str] | None:
    """Version and path of a Python that Blender's package has a wheel for."""
    for version in BPY_OF_PYTHON:
        for name in (f"python{version}", sys.executable, "python3", "python"):
            program = shutil.which(name)
            if program is None:
                continue
            code = "import sys, venv; print('%d.%d' % sys.version_info[:2])"
            answer = subprocess.run([program, "-c", code], capture_output=True, text=True, check=False)
            if answer.returncode == 0 and answer.stdout.strip() == version:
                return version, program
    return None


def _installer(python: Path) -> list[str]:
    """Words that install a package for another Python."""
    uv = shutil.which("uv")
    if uv is not None:
        return [uv, "pip", "install", "--python", str(python)]
    return [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(python),
        "install",
        "--no-input",
        "--disable-pip-version-check",
    ]


def _run(command: list[str], fault: str) -> None:
    """Run a program.

    Raises:
        ValueError: it failed; the message has its last line.
    """
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        lines = [line.strip() for line in (ended.stdout + ended.stderr).splitlines() if line.strip()]
        raise ValueError(f"doctor: {fault}: {lines[-1] if lines else f'exit code {ended.returncode}'}")
