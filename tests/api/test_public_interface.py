"""What `import droguekit` offers stays as it is, and comes quickly."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import droguekit
import droguekit.torch

SURFACE = Path(__file__).with_name("public_interface.txt")


def described(name: str, value: Any) -> list[str]:
    """A public object and its public members, a line each."""
    if not inspect.isclass(value):
        return [f"{name}{inspect.signature(value)}"]
    lines = [f"class {name}{inspect.signature(value)}"]
    for member, content in sorted(vars(value).items()):
        if member.startswith("_") and member not in ("__call__", "__getitem__", "__iter__", "__len__"):
            continue
        if inspect.isfunction(content):
            lines.append(f"    {name}.{member}{inspect.signature(content)}")
        elif isinstance(content, property) or type(content).__name__ == "cached_property":
            lines.append(f"    {name}.{member}")
    return lines


def test_the_interface_is_the_recorded_one() -> None:
    """After an intended change, replace the file by the lines that this test shows, and tell in the changelog."""
    lines: list[str] = []
    for name in droguekit.__all__:
        value = getattr(droguekit, name)
        # Types of files have fields, which are documented with the files.
        lines += [f"class {name}"] if name in ("NoFix", "PoseEstimate") else described(name, value)
    for name in ("PairDataset", "RenderStream", "sample_of_pair"):
        lines += [f"torch.{line.strip()}" for line in described(name, getattr(droguekit.torch, name))]
    found = re.sub(r" at 0x[0-9a-f]+", "", "\n".join(lines)) + "\n"
    assert found == SURFACE.read_text(encoding="utf-8")


def test_every_public_object_is_explained() -> None:
    for name in droguekit.__all__:
        assert (inspect.getdoc(getattr(droguekit, name)) or "").strip(), name


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, droguekit\n"
        "heavy = {'numpy', 'scipy', 'cv2', 'torch', 'mitsuba', 'numba', 'pydantic', 'matplotlib', 'pandas'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_an_unknown_name_is_an_attribute_error() -> None:
    assert not hasattr(droguekit, "magic")
    assert set(droguekit.__all__) <= set(dir(droguekit))
