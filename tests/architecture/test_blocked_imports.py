"""Navigation and benchmark work where no renderer, no mesh library and no torch can be imported."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ("mitsuba", "drjit", "bpy", "torch", "trimesh")
RENDERERS = ("mitsuba", "drjit", "bpy", "torch")

BLOCK = """
import importlib.abc, sys

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {blocked!r}:
            raise ImportError(f"{{name}} is blocked in this test")

sys.meta_path.insert(0, Blocked())
"""


def run_blocked(
    code: str, arguments: list[str], cwd: Path, blocked: tuple[str, ...] = HEAVY
) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process in which some packages cannot be imported."""
    return subprocess.run(
        [sys.executable, "-c", BLOCK.format(blocked=blocked) + code, *arguments],
        cwd=cwd,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


def run_commands_blocked(commands: list[list[str]], cwd: Path) -> None:
    """Run command lines one after the other in one such process; all must succeed."""
    code = (
        "from droguekit.cli.main import run; import json; sys.exit(any(run(each) for each in json.loads(sys.argv[1])))"
    )
    result = run_blocked(code, [json.dumps(commands)], cwd)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("package", HEAVY)
def test_the_block_holds(package: str, tmp_path: Path) -> None:
    result = run_blocked(f"import {package}", [], tmp_path)
    assert result.returncode == 1
    assert f"ImportError: {package} is blocked" in result.stderr


@pytest.mark.parametrize(
    ("blocked", "modules"),
    [
        (
            HEAVY,
            (
                "nav.runner",
                "droguekit.scoring.pose_benchmark",
                "droguekit.scoring.report.pose_report",
                "droguekit.cli.main",
            ),
        ),
        (
            RENDERERS,
            ("labelgen.frame_labels", "labelgen.validation.dataset_checks", "labelgen.export.annotations.coco"),
        ),
    ],
    ids=["navigation and benchmark", "labels"],
)
def test_modules_import_without_what_is_blocked(
    blocked: tuple[str, ...], modules: tuple[str, ...], tmp_path: Path
) -> None:
    # One process for all of them: each names itself in the traceback, and a blocked package never gets in.
    result = run_blocked("".join(f"import {module}\n" for module in modules), [], tmp_path, blocked)
    assert result.returncode == 0, result.stderr


def test_navigation_and_benchmark_run_without_renderer_meshes_and_torch(smoke_dataset: Path, tmp_path: Path) -> None:
    outputs = ["--json", "benchmark.json", "--html", "report.html"]
    # One process: each would spend seconds on its imports.
    run_commands_blocked(
        [
            ["navigate", str(smoke_dataset), "--method", "paper", "--method", "joint", "--out", "estimates.jsonl"],
            ["benchmark", str(smoke_dataset), "--estimates", "estimates.jsonl", *outputs],
        ],
        tmp_path,
    )
    result = json.loads((tmp_path / "benchmark.json").read_text(encoding="utf-8"))
    assert set(result["methods"]) == {"paper", "joint"}
    assert "<html" in (tmp_path / "report.html").read_text(encoding="utf-8").lower()
