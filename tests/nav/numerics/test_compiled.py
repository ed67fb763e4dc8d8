"""When functions are compiled anew, where the results are kept, and that they compute the same once loaded."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from geometry import compiled_loops
from geometry.compiled_loops import kept_on_disk
from nav.numerics.compiled import FASTMATH, is_finite

CALLEE = """
from geometry.compiled_loops import compiled

@compiled
def increased(number):
    return number + {step}
"""
CALLER = """
from geometry.compiled_loops import compiled
from looped.callee import increased

@compiled
def increased_twice(number):
    return increased(increased(number))
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of two modules of which one calls the other; a cache at home would be in a folder of its own."""
    folder = tmp_path / "looped"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "caller.py").write_text(CALLER, encoding="utf-8")
    (folder / "callee.py").write_text(CALLEE.format(step=1), encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield folder
    forget_package()


def forget_package() -> None:
    """Let the package be read anew, as by a new process."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "looped"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    compiled_loops._sources_digest.cache_clear()


def call() -> tuple[int, int, str]:
    """The caller's result with modules just read, its number of cache hits, and its cache folder."""
    forget_package()
    loop = importlib.import_module("looped.caller").increased_twice
    value = loop(1)
    return value, sum(loop.stats.cache_hits.values()), loop.stats.cache_path


def test_a_function_is_compiled_anew_when_one_that_it_calls_has_changed(package: Path) -> None:
    beside = str(package / "__pycache__")
    assert call() == (3, 0, beside)
    assert call() == (3, 1, beside)
    (package / "callee.py").write_text(CALLEE.format(step=10), encoding="utf-8")
    assert call() == (21, 0, beside)
    assert call() == (21, 1, beside)


def test_a_package_that_cannot_be_written_is_cached_at_home_and_else_not_at_all(package: Path) -> None:
    # A file where the folder would be: permissions would not keep a superuser out.
    (package / "__pycache__").touch()
    home = package.parent / "home"
    value, hits, where = call()
    assert (value, hits) == (3, 0) and Path(where).is_relative_to(home)
    assert call() == (3, 1, where)
    shutil.rmtree(home)
    home.touch()
    assert call()[:2] == (3, 0)
    assert call()[:2] == (3, 0)


def sum_of_roots(numbers: np.ndarray) -> float:
    total = 0.0
    for number in numbers:
        total += np.sqrt(number)
    return total


def hits_in_new_cache() -> int:
    """How often a fresh copy of the loop, which computes the right sum, came from the cache."""
    loop: Any = kept_on_disk(sum_of_roots, {"nogil": True})
    assert loop(np.array([4.0, 9.0])) == 5.0
    return sum(loop.stats.cache_hits.values())


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "truncated": lambda data: data[: len(data) // 2],
    "flipped": lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :],
    "another's": lambda data: b"junk" * 100,
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_damaged_file_of_the_cache_is_compiled_anew(
    damage: str, suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert [hits_in_new_cache(), hits_in_new_cache()] == [0, 1]
    (file,) = tmp_path.rglob(f"*{suffix}")
    file.write_bytes(DAMAGES[damage](file.read_bytes()))
    assert [hits_in_new_cache(), hits_in_new_cache()] == [0, 1]


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    loop: Any = kept_on_disk(sum_of_roots, {"nogil": True})
    shutil.rmtree(tmp_path / "cache")
    (tmp_path / "cache").touch()
    assert loop(np.array([4.0, 9.0])) == 5.0


POSES = """
import sys
import numpy as np
from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from geometry.stereo import paper_rig
from nav.pose.adjustment import adjust
from nav.pose.adjustment_loops import adjust_frames
from nav.pose.features import stack_features
from nav.pose.marker_geometry import project_markers

rig, layout = paper_rig(), marker_layout(PRESETS["red-8"])
rotations, translations_m = np.tile(np.eye(3), (20, 1, 1)), np.tile([0.1, 0.1, 5.0], (20, 1))
pixels = project_markers(rig, layout, rotations, translations_m)
pixels += np.random.default_rng(75).normal(0, 0.3, pixels.shape)
poses = adjust(stack_features(rig, layout, pixels, np.eye(2)), rotations, translations_m + 0.02)
np.savez(sys.argv[1], **vars(poses))
print(sum(adjust_frames.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_poses_of_loops_that_are_loaded_equal_those_of_loops_just_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    hits, poses = [], []
    for name in ("compiled.npz", "loaded.npz"):
        command = [sys.executable, "-c", POSES, str(tmp_path / name)]
        hits.append(int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout))
        with np.load(tmp_path / name) as arrays:
            poses.append(dict(arrays))
    assert hits == [0, 1]
    for name, values in poses[0].items():
        np.testing.assert_array_equal(values, poses[1][name], err_msg=name)


# Of functions that a loop calls, only those that compute nothing with floats may stay apart, as numba's count of
# references does.
APART = """
import sys
from numba.core.dispatcher import Dispatcher
from nav.realtime import warm_up_jit

warm_up_jit()
modules = [module for name, module in sys.modules.items() if name.startswith("nav.")]
loops = {loop for module in modules for loop in vars(module).values() if isinstance(loop, Dispatcher)}
for loop in loops:
    parts = [part for each in loop.overloads.values() for part in each.library.get_defined_functions()]
    apart = [part.name for part in parts if part.linkage.name != "external"
             and any(f" {operation} " in str(part) for operation in ("fadd", "fsub", "fmul", "fdiv"))]
    print(loop.__name__, *apart)
"""


@pytest.mark.slow
def test_machine_code_of_a_loop_holds_all_the_arithmetic_that_the_loop_calls(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", APART], env=environment, capture_output=True, text=True, check=True)
    apart = {loop: parts for loop, *parts in map(str.split, done.stdout.splitlines())}
    assert {"adjust_frames", "leverages", "draw_discs"} <= apart.keys()
    assert {loop: parts for loop, parts in apart.items() if parts} == {}


def test_numbers_are_told_from_infinities_and_nan_after_sums() -> None:
    # What numba's own test of a sum that it may reorder does not tell.
    summed: Any = numba.njit(
        lambda first, second, third: is_finite(first - np.log(second) - first / 2 - third), fastmath=FASTMATH
    )
    assert summed(1.0, 2.0, 3.0)
    for numbers in ((1.0, np.nan, 3.0), (np.inf, 2.0, 3.0), (1.0, 0.0, 3.0), (1.0, 2.0, np.nan)):
        assert not summed(*numbers)
