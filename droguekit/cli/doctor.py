"""`droguekit doctor`."""

from __future__ import annotations

import ctypes
import os
import platform
import sys

import typer

from droguekit.cli.main import FAULT

EXAMPLES = ("droguekit doctor",)
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


def doctor() -> None:
    """Show what is installed here, which engines work, and what is missing.

    Exits with 1 when the path tracer does not work; labels, navigation and benchmark work without any.
    """
    _show_machine()
    _show_packages()
    _show_viewer()
    _show_browser()
    if not _show_engines():
        raise typer.Exit(FAULT)


def _show_machine() -> None:
    from datasets_manifest.storage.provenance import cpu_features
    from droguekit.batch.execution import available_cores, available_memory_gib, default_workers

    typer.echo(f"python     {platform.python_version()}, {sys.executable}")
    typer.echo(f"system     {platform.platform()}")
    typer.echo(f"processor  {available_cores()} of {os.cpu_count()} cores; {' '.join(cpu_features())}")
    typer.echo(f"memory     {available_memory_gib():.1f} GiB free: {default_workers()} workers by default")


def _show_packages() -> None:
    from importlib.metadata import PackageNotFoundError, version

    for package in ("droguekit", *_PACKAGES):
        try:
            found = version(package)
        except PackageNotFoundError:
            found = "missing"
        typer.echo(f"package    {package} {found}")


def _show_viewer() -> None:
    """Load the rerun viewer's library, which is optional: nothing but `view` needs it."""
    try:
        import rerun
    except ImportError as error:
        typer.echo(f"viewer     rerun is optional: {error}; pip install 'droguekit[viz]'")
        return
    typer.echo(f"viewer     rerun {rerun.__version__}, for droguekit view")


def _show_browser() -> None:
    """Look for a browser, which is optional: nothing but the PDF of `report` needs it."""
    from droguekit.visualization.print_pdf import NO_BROWSER, find_browser

    found = find_browser()
    if found is None:
        typer.echo(f"browser    Chromium is optional: {NO_BROWSER}")
        return
    typer.echo(f"browser    {found}, for droguekit report --pdf")


def _show_engines() -> bool:
    """Try each engine; returns whether Mitsuba works (the analytic one needs nothing)."""
    from render.mitsuba_engine.variant import probe_variant

    typer.echo("engine     analytic works: flat discs without path tracing, for estimators")
    _show_blender()
    missing = _missing_libraries()
    for name, remedy in missing:
        typer.echo(f"library    {name} is missing; {remedy}")
    try:
        variant = probe_variant()
    except ValueError as error:
        typer.echo(f"engine     mitsuba does not work: {error}")
        return False
    if _LIBATOMIC in missing:
        typer.echo("engine     mitsuba does not work without libatomic.so.1")
        return False
    typer.echo(f"engine     mitsuba works as {variant.variant}: {variant.reason}")
    return True


def _show_blender() -> None:
    """Start Blender, which is optional: nothing else needs it."""
    from render.blender_engine.process import BlenderProcess, bpy_version

    try:
        found = bpy_version()
    except ValueError as error:
        typer.echo(f"engine     blender is optional: {error}")
        return
    missing = [package for library, package in _BLENDER_LIBRARIES.items() if not _loads(library)]
    if missing:
        typer.echo(f"engine     blender does not work: apt-get install {' '.join(missing)}")
        return
    try:
        BlenderProcess().close()
    except ValueError as error:
        typer.echo(f"engine     blender does not work: {error}")
        return
    typer.echo(f"engine     blender works: bpy {found}, Cycles on the CPU, in a process of its own")


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


_LIBATOMIC = ("libatomic.so.1", "apt-get install libatomic1")


def _missing_libraries() -> list[tuple[str, str]]:
    """System libraries that Mitsuba asks for and that are not here, each with what to do."""
    from render.mitsuba_engine.variant import llvm_libraries

    missing = []
    if not _loads(_LIBATOMIC[0]):
        missing.append(_LIBATOMIC)
    if not any(library.exists() for library in llvm_libraries()):
        missing.append(("LLVM >= 15", "apt-get install libllvm15 (or newer), or name one in DRJIT_LIBLLVM_PATH"))
    return missing
