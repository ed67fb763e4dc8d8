"""Which Pythons the project is for: the package, its set-up and the constraints say the same."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[2]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# torch is left to the package index where no build of it could be tested.
UNPINNED = {"3.11": set[str](), "3.12": {"torch"}, "3.13": {"torch"}, "3.14": {"torch"}}


def project() -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return table


def setup_text() -> str:
    return (REPOSITORY / "scripts" / "setup").read_text(encoding="utf-8")


def constraints(python: str) -> dict[str, str]:
    """Version by package of the file that set-up takes for a Python."""
    name = "constraints.txt" if python == "3.11" else "constraints-numpy2.txt"
    lines = (REPOSITORY / name).read_text(encoding="utf-8").splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {re.sub(r"[-_.]+", "-", package).lower(): version for package, version in pairs}


def test_classifiers_and_required_python_name_the_same_versions() -> None:
    found = [line.rsplit(" ", 1)[1] for line in project()["classifiers"] if "Python :: 3." in line]
    assert tuple(found) == PYTHONS
    required = SpecifierSet(project()["requires-python"])
    assert all(required.contains(f"{version}.0") for version in PYTHONS)
    assert not required.contains("3.10.99")


def test_set_up_takes_these_versions_the_newest_first() -> None:
    (named,) = re.findall(r'^pythons="(.*)"$', setup_text(), re.MULTILINE)
    assert tuple(named.split()) == PYTHONS[::-1]


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="what is installed here is not of constraints.txt")
def test_what_is_pinned_for_3_11_runs_on_the_one_of_debian_12() -> None:
    """Its Python is 3.11.2, and some packages ask for later ones."""
    pinned = constraints("3.11")
    asked = {
        each.name: each.metadata["Requires-Python"]
        for each in distributions()
        if canonicalize_name(each.name) in pinned and "Requires-Python" in each.metadata
    }
    assert len(asked) > 50
    assert {name: text for name, text in asked.items() if "3.11.2" not in SpecifierSet(text)} == {}


@pytest.mark.parametrize("python", PYTHONS)
def test_set_up_s_constraints_fit_what_the_package_asks_for(python: str) -> None:
    pinned = constraints(python)
    table = project()
    wanted = [*table["dependencies"], *(line for extra in table["optional-dependencies"].values() for line in extra)]
    unpinned, misfits = set(), []
    for requirement in map(Requirement, wanted):
        marker = {"python_version": python, "python_full_version": f"{python}.0", "extra": ""}
        if requirement.name == "droguekit" or (requirement.marker and not requirement.marker.evaluate(marker)):
            continue
        version = pinned.get(re.sub(r"[-_.]+", "-", requirement.name).lower())
        if version is None and not any(item.operator == "==" for item in requirement.specifier):
            unpinned.add(requirement.name)
        elif version is not None and not requirement.specifier.contains(version):
            misfits.append(f"{requirement}: {version}")
    assert misfits == []
    assert unpinned == UNPINNED[python]


def test_the_oldest_python_keeps_numpy_1_and_the_others_take_numpy_2() -> None:
    assert {python: constraints(python)["numpy"].split(".")[0] for python in PYTHONS} == {
        "3.11": "1",
        "3.12": "2",
        "3.13": "2",
        "3.14": "2",
    }


def fake_python(folder: Path, name: str, version: str) -> None:
    """A program that answers as a Python of this version does when it is asked for its version."""
    path = folder / name
    path.write_text(f"#!/bin/sh\necho {version}\n", encoding="ascii")
    path.chmod(0o755)


def chosen_python(tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run set-up's choice of a Python in an empty clone, with the programs in `bin` alone on the search path."""
    text = setup_text()
    choice = text[: text.index("fingerprint=")] + 'echo "$python $python_version $constraints $oldest_llvm"\n'
    script = tmp_path / "scripts" / "setup"
    script.parent.mkdir(exist_ok=True)
    script.write_text(choice, encoding="utf-8")
    own = {"PATH": f"{tmp_path / 'bin'}:/usr/bin:/bin", **environment}
    inherited = {name: value for name, value in os.environ.items() if name not in ("PYTHON", "PATH")}
    return subprocess.run(
        ["/bin/bash", str(script)], env={**inherited, **own}, capture_output=True, text=True, check=False
    )


def test_set_up_prefers_the_named_python_then_that_of_the_environment_then_the_newest(tmp_path: Path) -> None:
    folder = tmp_path / "bin"
    folder.mkdir()
    for version in PYTHONS:
        fake_python(folder, f"python{version}", version)
    fake_python(folder, "python3.10", "3.10")
    assert chosen_python(tmp_path).stdout.split() == ["python3.14", "3.14", "constraints-numpy2.txt", "17"]
    named = chosen_python(tmp_path, PYTHON="python3.11")
    assert named.stdout.split() == ["python3.11", "3.11", "constraints.txt", "15"]
    refused = chosen_python(tmp_path, PYTHON="python3.10")
    assert refused.returncode == 2
    assert refused.stderr == (
        "setup: PYTHON=python3.10 is none of the Pythons that droguekit supports: 3.14 3.13 3.12 3.11\n"
    )
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    fake_python(tmp_path / ".venv" / "bin", "python", "3.12")
    assert chosen_python(tmp_path).stdout.split()[:2] == [".venv/bin/python", "3.12"]


def test_this_python_is_one_of_them() -> None:
    assert f"{sys.version_info.major}.{sys.version_info.minor}" in PYTHONS
