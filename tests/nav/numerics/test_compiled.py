"""When compiled functions are compiled anew, and where the results are kept."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nav.numerics import compiled

CALLEE = """
from nav.numerics.compiled import compiled

@compiled
def increased(number):
    return number + {step}
"""
CALLER = """
from nav.numerics.compiled import compiled
from nav.loops.callee import increased

@compiled
def increased_twice(number):
    return increased(increased(number))
"""
CALL = """
from nav.loops.caller import increased_twice
print(increased_twice(1), sum(increased_twice.stats.cache_hits.values()), increased_twice.stats.cache_path)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package `nav` with the project's own `compiled`, and two modules of which one calls the other."""
    for name in ("numerics", "loops"):
        (tmp_path / "nav" / name).mkdir(parents=True)
        (tmp_path / "nav" / name / "__init__.py").touch()
    (tmp_path / "nav" / "__init__.py").touch()
    shutil.copy(compiled.__file__, tmp_path / "nav" / "numerics" / "compiled.py")
    (tmp_path / "nav" / "loops" / "caller.py").write_text(CALLER, encoding="utf-8")
    (tmp_path / "nav" / "loops" / "callee.py").write_text(CALLEE.format(step=1), encoding="utf-8")
    return tmp_path


def call(package: Path) -> tuple[int, int, str]:
    """The caller's result in a new process, its number of cache hits, and its cache folder."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_")}
    home = str(package / "home")
    environment |= {"PYTHONPATH": str(package), "HOME": home, "XDG_CACHE_HOME": home, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", CALL]
    done = subprocess.run(command, cwd=package, env=environment, capture_output=True, text=True, check=True)
    value, hits, *where = done.stdout.split()
    return int(value), int(hits), "".join(where)


def test_a_function_is_compiled_anew_when_one_that_it_calls_has_changed(package: Path) -> None:
    beside = str(package / "nav" / "loops" / "__pycache__")
    assert call(package) == (3, 0, beside)
    assert call(package) == (3, 1, beside)
    (package / "nav" / "loops" / "callee.py").write_text(CALLEE.format(step=10), encoding="utf-8")
    assert call(package) == (21, 0, beside)
    assert call(package) == (21, 1, beside)


def test_a_package_that_cannot_be_written_is_cached_at_home_and_else_not_at_all(package: Path) -> None:
    # A file where the folder would be: permissions would not keep a superuser out.
    (package / "nav" / "loops" / "__pycache__").touch()
    value, hits, where = call(package)
    assert (value, hits) == (3, 0) and Path(where).is_relative_to(package / "home")
    assert call(package) == (3, 1, where)
    shutil.rmtree(package / "home")
    (package / "home").touch()
    assert call(package)[:2] == (3, 0)
    assert call(package)[:2] == (3, 0)
