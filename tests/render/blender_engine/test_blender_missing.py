"""What is said where Blender is not installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def test_blender_that_is_not_installed_is_named_in_one_line(tmp_path: Path) -> None:
    blocked = tmp_path / "blocked"
    blocked.mkdir()
    # What the package's metadata look like where it is missing.
    (blocked / "sitecustomize.py").write_text(
        "import importlib.metadata as metadata\n"
        "found = metadata.Distribution.from_name\n"
        "def from_name(name):\n"
        "    if name == 'bpy':\n"
        "        raise metadata.PackageNotFoundError(name)\n"
        "    return found(name)\n"
        "metadata.Distribution.from_name = staticmethod(from_name)\n"
    )
    out = tmp_path / "out"
    command = [sys.executable, "-m", "droguekit.cli.main", "render", "smoke", "--engine", "blender", "--out", str(out)]
    python_path = os.pathsep.join([str(blocked), *filter(None, [os.environ.get("PYTHONPATH")])])
    result = subprocess.run(
        command, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": python_path}
    )
    assert result.returncode == 2
    assert "engine blender: not installed; install it with: pip install 'droguekit[blender]'" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not out.exists()
