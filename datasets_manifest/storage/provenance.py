"""Conventions of a dataset's numbers, and the software and processor with which they were made."""

from __future__ import annotations

import platform
import re
from collections.abc import Collection, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

CONVENTIONS = {
    "transforms": "a_from_b takes coordinates in b to coordinates in a; 4x4, row-major",
    "camera_axes": "x right, y down, z forward",
    "drogue_axes": "origin at the centre of the marker circle in the rim plane, z from the mouth to the hose",
    "world_axes": "x east, y north, z up",
    "body_axes": "x forward, y right, z down",
    "units": "metres, seconds, cd/m2; angles in degrees where a name ends in _deg",
    "pixel_centre": "integer coordinates are pixel centres; the full frame is [-0.5, -0.5, width, height]",
    "coco_pixels": "COCO files add 0.5 to boxes and keypoints: their origin is the corner of the image",
    "quaternion_order": "x y z w, wherever an export writes quaternions",
    "attitude": "left_from_drogue rotation = Ry(yaw) Rx(pitch) Rz(roll)",
    "time": "of the middle of the exposure",
}

_CPU_INFO = Path("/proc/cpuinfo")
_SOFTWARE = ("droguekit", "numpy", "scipy", "opencv-python-headless", "pydantic", "trimesh", "mitsuba", "drjit", "bpy")


def software_versions() -> dict[str, str]:
    """Versions of Python and of the installed packages on which pixels and labels depend."""
    versions = {"python": platform.python_version()}
    for package in _SOFTWARE:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions


def cpu_features() -> list[str]:
    """Instruction sets that numpy found on this machine, and the processor's maker and model where the system tells.

    They decide the last bits of derived numbers: libraries and compilers choose their code by all of them, and two
    models of one maker with equal instruction sets render different pixels.
    """
    # numpy's stubs leave out the form with `mode`.
    report: dict[str, Any] = np.show_config(mode="dicts")  # type: ignore[call-arg, assignment, func-returns-value]
    extensions = report["SIMD Extensions"]
    return [*extensions.get("baseline", ()), *extensions.get("found", ()), *_processor(_CPU_INFO)]


def _processor(cpu_info: Path) -> list[str]:
    """Maker and model of a Linux machine's processor, such as `AuthenticAMD`, `family 25 model 17`, as far as known."""
    try:
        text = cpu_info.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    maker, family, model = (
        re.search(rf"^{key}\s*:\s*(\S+)", text, re.M) for key in ("vendor_id", "cpu family", "model")
    )
    found = [] if maker is None else [maker.group(1)]
    return found if family is None or model is None else [*found, f"family {family.group(1)} model {model.group(1)}"]


def differing_builds(
    other_software: Mapping[str, str],
    other_features: Collection[str],
    own_software: Mapping[str, str],
    own_features: Collection[str],
) -> list[str]:
    """Differences in software and processor from another build, a line each; equal builds make equal pixels."""
    found = [
        f"{name} {other_software.get(name, 'missing')} there, {own_software.get(name, 'missing')} here"
        for name in sorted({*other_software, *own_software})
        if other_software.get(name) != own_software.get(name)
    ]
    return found if set(other_features) == set(own_features) else [*found, "another set of processor features"]
