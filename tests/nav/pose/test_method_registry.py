"""Pose methods of other packages, registered by entry points."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nav.pose.method_registry import METHODS, method_names, pose_method
from nav.pose.pose_method import NoFixReason
from nav.runner import method_names as names_of_runner
from tests.support.painted_pairs import draw_poses

NAMES = (
    "paper paper-literal circle-fit mono-circle mean-plane disparity-plane mono-ippe mono-sqpnp mono-lm "
    "joint joint-hub joint-robust joint-rim constant"
)

MODULE = """
from nav.pose.pose_method import NoFixReason

def never(observation):
    return NoFixReason("never sure")

def nothing(observation):
    return None

number = 7
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Install a tiny distribution whose entry points are the given lines."""

    def write(lines: str, name: str = "other_estimators") -> None:
        folder = tmp_path / name
        metadata = folder / f"{name}-1.0.dist-info"
        metadata.mkdir(parents=True)
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
        points = f"[droguekit.pose_estimators]\n{lines}\n"
        (metadata / "entry_points.txt").write_text(points, encoding="utf-8")
        Path(folder / f"{name}.py").write_text(MODULE, encoding="utf-8")
        monkeypatch.syspath_prepend(str(folder))
        importlib.invalidate_caches()

    return write


def test_built_in_methods() -> None:
    assert list(METHODS) == NAMES.split()
    assert names_of_runner() == method_names()
    assert method_names()[: len(METHODS)] == tuple(METHODS)


def test_a_method_of_another_package(install: Callable[..., Any]) -> None:
    install("never = other_estimators:never")
    assert method_names() == (*METHODS, "never")
    observation = draw_poses(np.random.default_rng(81), 1, 5.0, 0.1).observation(0)
    answer = pose_method("never")(observation)
    assert isinstance(answer, NoFixReason)
    assert answer.reason == "never sure"


def test_a_name_that_is_taken(install: Callable[..., Any]) -> None:
    install("joint = other_estimators:never")
    with pytest.raises(ValueError, match="other_estimators:never registers 'joint', which is taken"):
        method_names()


def test_two_packages_with_one_name(install: Callable[..., Any]) -> None:
    install("never = other_estimators:never")
    install("never = more_estimators:never", "more_estimators")
    with pytest.raises(ValueError, match="registers 'never', which is taken"):
        pose_method("never")


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("broken = absent_module:solve", "method: 'broken' cannot be loaded from absent_module:solve"),
        ("broken = other_estimators:absent", "method: 'broken' cannot be loaded from other_estimators:absent"),
        ("broken = other_estimators:number", "method: 'broken' must be a function, got int"),
    ],
)
def test_a_method_that_cannot_be_loaded(install: Callable[..., Any], line: str, fault: str) -> None:
    install(line)
    # It is listed, because listing loads nothing.
    assert "broken" in method_names()
    with pytest.raises(ValueError, match=re.escape(fault)):
        pose_method("broken")


def test_a_method_that_returns_another_type(install: Callable[..., Any]) -> None:
    install("nothing = other_estimators:nothing")
    observation = draw_poses(np.random.default_rng(82), 1, 5.0, 0.1).observation(0)
    with pytest.raises(ValueError, match="method: 'nothing' must answer Solution or NoFixReason, got NoneType"):
        pose_method("nothing")(observation)


def test_an_unknown_name_lists_all(install: Callable[..., Any]) -> None:
    install("never = other_estimators:never")
    with pytest.raises(ValueError, match=r"no pose method named 'best'; there are paper, .*, constant, never"):
        pose_method("best")
