"""The wheel holds what the program needs, and works where nothing of the repository can be seen."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = ("droguekit", "labelgen", "nav", "render", "scenes", "datasets_manifest", "drogue_models", "geometry")


def run(arguments: list[str], **options: object) -> str:
    result = subprocess.run(arguments, capture_output=True, text=True, check=False, **options)  # type: ignore[call-overload]
    assert result.returncode == 0, result.stdout + result.stderr
    return str(result.stdout)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of the sources: building in place leaves folders behind that later builds pick up."""
    source = tmp_path_factory.mktemp("source")
    for package in PACKAGES:
        shutil.copytree(REPOSITORY / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPOSITORY / name, source)
    out = tmp_path_factory.mktemp("wheel")
    run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(source)], cwd=out)
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing but the installed wheel."""
    folder = tmp_path_factory.mktemp("installed")
    run([sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--target", str(folder), str(wheel)])
    return folder


def run_installed(installed: Path, code: str, *arguments: str) -> str:
    """Run code with the installed wheel and the environment's libraries, but without the repository.

    `-S` leaves out the editable install's hooks, `-P` the working folder.
    """
    paths = os.pathsep.join([str(installed), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    environment = {**os.environ, "PYTHONPATH": paths}
    return run([sys.executable, "-S", "-P", "-c", code, *arguments], cwd=installed.parent, env=environment)


def test_holds_every_module_and_data_file(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        str(path.relative_to(REPOSITORY))
        for package in PACKAGES
        for pattern in ("*.py", "py.typed", "recipes/*.toml", "published/*.json", "examples/*", "templates/*")
        for path in (REPOSITORY / package).rglob(pattern)
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert sorted(wanted - names) == []
    assert any(name.startswith("datasets_manifest/recipes/") for name in names)
    assert any(name.startswith("drogue_models/examples/") for name in names)
    assert any(name.startswith("droguekit/scoring/report/templates/") for name in names)


def test_holds_only_our_packages_and_the_licence(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info" not in name}
    assert tops == set(PACKAGES)
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_the_container_is_built_from_what_the_wheel_is_built_from() -> None:
    lines = (REPOSITORY / ".dockerignore").read_text(encoding="utf-8").splitlines()
    rules = [line for line in lines if not line.startswith("#")]
    # Everything is left out, and then these are let in again.
    assert rules[0] == "*"
    let_in = {rule[1:] for rule in rules if rule.startswith("!")}
    assert let_in == {*PACKAGES, "pyproject.toml", "README.md", "LICENSE", "constraints.txt"}


def test_every_data_folder_is_packaged() -> None:
    # A file that is neither code nor named in pyproject.toml would be missing from the wheel without a word.
    package_data = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = package_data["tool"]["setuptools"]["package-data"]
    named = {"py.typed"} | {
        str(path.relative_to(REPOSITORY))
        for package, globs in patterns.items()
        if package != "*"
        for pattern in globs
        for path in REPOSITORY.joinpath(*package.split(".")).glob(pattern)
    }
    left_out = [
        path
        for package in PACKAGES
        for path in (REPOSITORY / package).rglob("*")
        if path.is_file()
        and path.suffix != ".py"
        and path.parent.name != "__pycache__"
        and path.name != "py.typed"
        and str(path.relative_to(REPOSITORY)) not in named
    ]
    assert left_out == []


def test_installed_clean_it_lists_and_reads_its_recipes(installed: Path) -> None:
    code = """
import datasets_manifest.recipe.recipe as recipe
print(recipe.__file__)
for name in recipe.recipe_names():
    print(recipe.load_recipe(name).recipe.name)
"""
    where, *names = run_installed(installed, code).split()
    assert Path(where).is_relative_to(installed)
    assert names == sorted(path.stem for path in (REPOSITORY / "datasets_manifest" / "recipes").glob("*.toml"))


def test_installed_clean_the_command_answers(installed: Path) -> None:
    code = "import sys; from droguekit.cli.main import run; sys.exit(run(sys.argv[1:]))"
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert run_installed(installed, code, "--version").strip() == f"droguekit {project['version']}"
    assert "render" in run_installed(installed, code, "--help")


def test_installed_clean_the_report_says_that_it_needs_a_clone(installed: Path) -> None:
    code = "import sys; from droguekit.cli.main import run; print(run(['report', '--help']))"
    paths = os.pathsep.join([str(installed), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    result = subprocess.run(
        [sys.executable, "-S", "-P", "-c", code],
        cwd=installed.parent,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stdout.strip() == "2"
    assert (
        result.stderr
        == "droguekit: error: report: is no part of the installed package; run it in a clone of the repository\n"
    )
