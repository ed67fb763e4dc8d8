"""Rules that every module of our packages keeps: names, sizes, randomness, clocks."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SHIPPED = ("droguekit", "labelgen", "nav", "render", "scenes", "datasets_manifest", "drogue_models", "geometry")
PACKAGES = (*SHIPPED, "studies")
# Packages whose results must not depend on when they run; droguekit and nav measure time and report it.
TIMELESS = ("labelgen", "render", "scenes", "datasets_manifest", "drogue_models", "geometry")
MAX_LINES = 500
MAX_MODULES = 15
# What may be taken from numpy.random: streams that are made from an explicit key.
KEYED = {"default_rng", "SeedSequence", "Philox", "PCG64", "PCG64DXSM", "SFC64"}
SEEDED = {*KEYED, "Generator", "BitGenerator"}
WALL_CLOCK = {"time.time", "time.time_ns", "datetime.now", "datetime.utcnow", "datetime.today", "date.today"}


def source_files(packages: tuple[str, ...] = PACKAGES) -> list[Path]:
    return sorted(path for package in packages for path in (REPOSITORY / package).rglob("*.py"))


def dotted(node: ast.expr) -> str:
    """`a.b.c` of an attribute chain, empty for anything else."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        before = dotted(node.value)
        return f"{before}.{node.attr}" if before else ""
    return ""


def hidden_randomness(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of every use of a global or unseeded random generator."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names if alias.name == "random")
        elif isinstance(node, ast.ImportFrom) and node.module in ("random", "numpy.random"):
            used = {alias.name for alias in node.names}
            if node.module == "random" or not used <= SEEDED:
                yield node.lineno, node.module
        elif isinstance(node, ast.Attribute):
            name = dotted(node)
            for prefix in ("np.random.", "numpy.random."):
                if name.startswith(prefix) and name.removeprefix(prefix).split(".")[0] not in SEEDED:
                    yield node.lineno, name
        elif isinstance(node, ast.Call):
            made = dotted(node.func).rsplit(".", 1)[-1]
            if made in KEYED and not node.args and not node.keywords:
                yield node.lineno, f"{made}() without a seed"


def wall_clock(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of every look at the time of day."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ".".join(dotted(node).split(".")[-2:]) in WALL_CLOCK:
            yield node.lineno, dotted(node)
        elif isinstance(node, ast.ImportFrom) and node.module == "time":
            yield from ((node.lineno, "time.time") for alias in node.names if alias.name in ("time", "time_ns"))


def sent_from_an_entry_point(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of everything of a `__main__` module that it gives to other processes.

    A process that multiprocessing spawns does not import `PACKAGE.__main__`, so it finds nothing of it.
    """
    own = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and dotted(node.func) in ("run_in_own_process", "run_tasks"):
            names = (each for argument in node.args for each in ast.walk(argument) if isinstance(each, ast.Name))
            yield from ((name.lineno, name.id) for name in names if name.id in own)


def found_in(packages: tuple[str, ...], rule: Callable[[ast.AST], Iterator[tuple[int, str]]]) -> list[str]:
    return [
        f"{path.relative_to(REPOSITORY)}:{line}: {what}"
        for path in source_files(packages)
        for line, what in rule(ast.parse(path.read_text(encoding="utf-8"), filename=str(path)))
    ]


def test_no_hidden_randomness() -> None:
    assert found_in(PACKAGES, hidden_randomness) == []


@pytest.mark.parametrize(
    "code",
    [
        "np.random.rand(3)",
        "numpy.random.seed(0)",
        "import random",
        "from random import choice",
        "from numpy.random import normal",
        "np.random.default_rng()",
        "def f(rng=default_rng()): ...",
        "np.random.SFC64()",
    ],
)
def test_hidden_randomness_is_found(code: str) -> None:
    assert list(hidden_randomness(ast.parse(code)))


def test_keyed_streams_pass() -> None:
    code = "def f(seed: int) -> np.random.Generator:\n  return np.random.Generator(np.random.Philox(seed))"
    assert list(hidden_randomness(ast.parse(code))) == []


def test_data_do_not_depend_on_the_time_of_day() -> None:
    assert found_in(TIMELESS, wall_clock) == []


@pytest.mark.parametrize(
    "code", ["time.time()", "datetime.datetime.now()", "from time import time", "x = date.today()"]
)
def test_a_look_at_the_clock_is_found(code: str) -> None:
    assert list(wall_clock(ast.parse(code)))


def test_other_processes_get_nothing_from_an_entry_point() -> None:
    found = {
        str(path.relative_to(REPOSITORY)): [*sent_from_an_entry_point(ast.parse(path.read_text(encoding="utf-8")))]
        for path in source_files()
        if path.name == "__main__.py"
    }
    assert found and not any(found.values()), found


def test_a_function_that_an_entry_point_sends_is_found() -> None:
    code = "def work(): ...\nrun_in_own_process(partial(work, 1))\nrun_in_own_process(partial(imported, 1))\n"
    assert [*sent_from_an_entry_point(ast.parse(code))] == [(2, "work")]


def test_modules_stay_small() -> None:
    sizes = {
        path.relative_to(REPOSITORY): len(path.read_text(encoding="utf-8").splitlines()) for path in source_files()
    }
    assert {str(path): lines for path, lines in sizes.items() if lines > MAX_LINES} == {}


def test_folders_stay_small() -> None:
    counts = Counter(path.parent for path in source_files() if path.stem != "__init__")
    assert {str(folder): count for folder, count in counts.items() if count > MAX_MODULES} == {}


def test_a_public_class_name_means_one_thing() -> None:
    places: dict[str, list[str]] = {}
    for path in source_files():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(str(path.relative_to(REPOSITORY)))
    assert {name: files for name, files in places.items() if len(files) > 1} == {}


def test_a_module_name_means_one_thing() -> None:
    counts = Counter(path.name for path in source_files() if not path.stem.startswith("__"))
    assert {name: count for name, count in counts.items() if count > 1} == {}


def test_no_module_without_a_meaning() -> None:
    assert [path for path in source_files() if path.stem in ("utils", "helpers", "common", "misc")] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_are_typed(package: str) -> None:
    assert (REPOSITORY / package / "py.typed").is_file()


def test_every_folder_with_modules_is_a_package() -> None:
    # setuptools leaves a folder without __init__.py out of the wheel.
    assert [path.parent for path in source_files() if not (path.parent / "__init__.py").is_file()] == []


def test_no_module_is_named_like_a_package_that_is_installed() -> None:
    # A script that is run from its own folder would import the wrong one. Renderers that are optional count too.
    installed = set(packages_distributions()) - set(PACKAGES) | {
        "cycles",
        "mitsuba",
        "drjit",
        "bpy",
        "trimesh",
        "torch",
    }
    names = {path: path.parent.name if path.stem == "__init__" else path.stem for path in source_files()}
    # `droguekit.torch` is what users import, and its folder has no script.
    named_alike = {f"{path.relative_to(REPOSITORY)}" for path, name in names.items() if name in installed}
    assert named_alike == {"droguekit/torch.py"}


def test_none_of_our_packages_is_shadowed_by_the_renderer(tmp_path: Path) -> None:
    code = f"""
import mitsuba
mitsuba.set_variant("scalar_rgb")
import importlib
for name in {SHIPPED!r}:
    print(importlib.import_module(name).__file__)
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split("\n")[:-1] == [str(REPOSITORY / name / "__init__.py") for name in SHIPPED]
