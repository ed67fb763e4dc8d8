"""The walls between the packages stand, and each of them stops the import that it is there to stop."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SETTINGS = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
PACKAGES = SETTINGS["root_packages"]

# Of each wall: a module and the import in it that must not pass.
TRESPASSES = [
    ("packages", "geometry/trespass.py", "import drogue_models.parameters"),
    ("packages", "scenes/trespass.py", "import render.engine"),
    ("packages", "datasets_manifest/trespass.py", "import scenes.sampler"),
    ("packages", "labelgen/trespass.py", "import nav.runner"),
    ("packages", "droguekit/trespass.py", "import studies.acceptance.acceptance_table"),
    ("application", "droguekit/workflows/trespass.py", "import droguekit.cli.main"),
    ("application", "droguekit/scoring/trespass.py", "import droguekit.batch.worker_pool"),
    ("application", "droguekit/batch/trespass.py", "import droguekit.scoring.pose_benchmark"),
    ("application", "droguekit/batch/trespass.py", "import droguekit.cli.main"),
    ("blind", "nav/trespass.py", "import datasets_manifest.types.records"),
    ("blind", "nav/pose/trespass.py", "from datasets_manifest.storage import reader"),
    ("blind", "nav/trespass.py", "import datasets_manifest"),
    ("training", "nav/pose/trespass.py", "import nav.training"),
    ("no-generator", "nav/trespass.py", "def f():\n    import scenes.sampler"),
    ("no-generator", "droguekit/scoring/trespass.py", "import labelgen.frame_labels"),
    ("light", "nav/trespass.py", "import drogue_models.meshes"),
    ("light", "droguekit/scoring/trespass.py", "import trimesh"),
    ("renderers", "labelgen/trespass.py", "import mitsuba"),
    ("renderers", "droguekit/cli/trespass.py", "import drjit"),
    ("blender", "render/blender_engine/blender_engine.py", "import render.blender_engine.blender_scene"),
    ("blender", "droguekit/batch/trespass.py", "import bpy"),
    ("dimensions", "drogue_models/parameters.py", "import trimesh"),
    ("torch", "nav/pose/trespass.py", "import torch"),
    ("torch", "droguekit/scoring/trespass.py", "import torch"),
    ("geometry", "geometry/trespass.py", "import cv2"),
    ("cycles", "datasets_manifest/storage/layout.py", "import datasets_manifest.storage.reader"),
]


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the import contracts on the packages that lie in a folder."""
    code = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
    return subprocess.run(
        [sys.executable, "-c", code, "--no-cache", "--no-logo"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "1000"},
        capture_output=True,
        text=True,
        check=False,
    )


def trespassing_module(place: int, module: str) -> str:
    """A module of a trespass's own where it is none of ours, so that all can be there at once."""
    return module.replace("trespass", f"trespass_{place}")


@pytest.fixture(scope="module")
def broken_walls(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the linter says of each contract when all trespasses are in a copy of our packages, by the contract's id."""
    folder = tmp_path_factory.mktemp("walls")
    for package in PACKAGES:
        shutil.copytree(REPOSITORY / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(REPOSITORY / "pyproject.toml", folder)
    for place, (_, module, statement) in enumerate(TRESPASSES):
        with (folder / trespassing_module(place, module)).open("a", encoding="utf-8") as file:
            file.write(f"\n{statement}\n")
    result = lint(folder)
    assert result.returncode == 1, result.stdout + result.stderr
    told = result.stdout.partition("Broken contracts")[2]
    # A heading is a contract's name, underlined.
    parts = re.split(r"^(.+)\n-+\n", told, flags=re.MULTILINE)
    found = dict(zip(parts[1::2], parts[2::2], strict=True))
    return {contract["id"]: found.get(contract["name"], "") for contract in SETTINGS["contracts"]}


def test_the_contracts_hold() -> None:
    result = lint(REPOSITORY)
    assert result.returncode == 0, result.stdout + result.stderr


def test_every_contract_has_a_trespass_that_tests_it() -> None:
    assert {wall for wall, _, _ in TRESPASSES} == {contract["id"] for contract in SETTINGS["contracts"]}


@pytest.mark.parametrize("place", range(len(TRESPASSES)))
def test_a_wall_stops_what_it_is_there_for(broken_walls: dict[str, str], place: int) -> None:
    wall, module, statement = TRESPASSES[place]
    importer = trespassing_module(place, module).removesuffix(".py").replace("/", ".")
    (node,) = (node for node in ast.walk(ast.parse(statement)) if isinstance(node, ast.Import | ast.ImportFrom))
    package = f"{node.module}." if isinstance(node, ast.ImportFrom) else ""
    chain = f"{importer} -> {package}{node.names[0].name} (l."
    if wall == "cycles":
        chain = "- .layout -> .reader (1 import)"
    # The trespass begins the chain of imports.
    assert re.search(rf"^(- +)?{re.escape(chain)}", broken_walls[wall], re.MULTILINE), broken_walls[wall]


def test_geometry_imports_nothing_but_numpy_and_scipy() -> None:
    # The contract names the libraries that geometry must not use; this names those that it may. Sampling of images is
    # OpenCV's, and compilation numba's.
    graph = grimp.build_graph(*PACKAGES, include_external_packages=True, cache_dir=None)
    modules = {"geometry", *graph.find_descendants("geometry")} - {
        "geometry.bilinear_sampling",
        "geometry.compiled_loops",
    }
    imported = {name.split(".")[0] for module in modules for name in graph.find_modules_directly_imported_by(module)}
    assert imported - set(sys.stdlib_module_names) <= {"geometry", "numpy", "scipy"}
