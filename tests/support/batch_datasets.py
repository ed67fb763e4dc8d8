"""Datasets of tiny recipes, engines with accidents, and how tests make them: fixtures of batch and studies."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from datasets_manifest.recipe.recipe import RecipeSource, parse_recipe
from datasets_manifest.storage.layout import EVENTS_FILE
from droguekit.batch.execution import ExecutionOptions
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import RunSummary, render_dataset
from tests.support.recipe_builder import PLAIN_SKY, RIG_160_PX, RIG_320_PX, between, recipe_text
from tests.support.shared_folder import shared_folder

# For what asks where surfaces lie and not for their light.
FEWEST_RAYS = {
    "samples_per_px": 1,
    "open_samples_per_px": 1,
    "edge_samples_per_px": 1,
    "surround_samples_per_px": 1,
    "max_depth": 2,
}

# Four pairs of 320 x 240 pixels.
TINY_RECIPE = recipe_text(
    name="tiny",
    seed=5,
    rig=RIG_320_PX,
    frames={"count": 4, "scenes": 2},
    distance=between(3.0, 12.0, "log-uniform"),
    environment=PLAIN_SKY,
    render=FEWEST_RAYS,
    split={"train": 0.5, "test": 0.5},
)

# A real engine that other packages could bring: the analytic one, with accidents on frames that the environment names.
TROUBLED_ENGINE = """
import ctypes, json, os, resource
from pathlib import Path
from render.analytic_engine.analytic_engine import AnalyticEngine

class TroubledEngine(AnalyticEngine):
    def render(self, frame, settings):
        for trouble, frames in json.loads(os.environ.get("TROUBLES", "{}")).items():
            if frame.frame_index in frames:
                getattr(self, trouble)(frame.frame_index)
        return super().render(frame, settings)

    def abort(self, index):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        os.abort()

    def abort_once(self, index):
        if self._first("abort", index):
            self.abort(index)

    def hang(self, index):
        ctypes.PyDLL(None).pause()  # holds Python's lock: nothing in this process can end it

    def hang_once(self, index):
        if self._first("hang", index):
            self.hang(index)

    def refuse(self, index):
        raise RuntimeError(f"frame {index} is\\nbeyond me")

    def no_space(self, index):
        raise OSError(28, "No space left on device", "/scratch")

    def wait(self, index):
        # Opening a pipe waits for its other end: tells that the frame is begun, and goes on when it is told.
        with open(os.environ["TROUBLE_BEGUN"], "w") as stream:
            stream.write(f"{index}\\n")
        with open(os.environ["TROUBLE_GO_ON"]) as stream:
            stream.read()

    def _first(self, name, index):
        mark = Path(os.environ["TROUBLE_MARKS"]) / f"{name}-{index}"
        known = mark.exists()
        mark.touch()
        return not known
"""

# Eight pairs of 160 x 120 pixels by the engine `troubled`.
QUICK_RECIPE = recipe_text(
    name="quick",
    seed=5,
    rig=RIG_160_PX,
    frames={"count": 8, "scenes": 2},
    distance=between(3.0, 12.0, "log-uniform"),
    environment=PLAIN_SKY,
    render={"engine": "troubled"},
    split={"train": 0.5, "test": 0.5},
)

# The same pairs by the engine that ships.
ANALYTIC_RECIPE = QUICK_RECIPE.replace('"troubled"', '"analytic"')


def render_recipe(
    out: Path | str,
    frames: Sequence[int] | None = None,
    workers: int | ExecutionOptions = 1,
    text: str = TINY_RECIPE,
    told: io.StringIO | None = None,
) -> RunSummary:
    """Render frames of a recipe, all of them unless some are named; progress goes to `told` or nowhere."""
    recipe = parse_recipe(text)
    chosen = range(recipe.frames.count) if frames is None else frames
    return render_dataset(RecipeSource(recipe, text), out, chosen, workers, PlainProgress(told or io.StringIO()))


def file_hashes(dataset: Path) -> dict[str, str]:
    """Hashes of a dataset's files by their path, without the events, which tell of times and hosts."""
    return {
        str(path.relative_to(dataset)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(dataset.rglob("*"))
        if path.is_file() and path.name != EVENTS_FILE
    }


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `TINY_RECIPE`, made in one process in ascending order; to be read only."""

    def render(out: Path) -> None:
        assert render_recipe(out, workers=0).drops == ()

    return shared_folder(tmp_path_factory, "tiny", render)


@pytest.fixture(scope="session")
def troubled_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of Python packages with the engine `troubled` installed in it."""
    site = tmp_path_factory.mktemp("site")
    (site / "troubled_engine.py").write_text(TROUBLED_ENGINE)
    information = site / "troubled_engine-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: troubled-engine\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[droguekit.engines]\ntroubled = troubled_engine:TroubledEngine\n")
    return site


@pytest.fixture
def troubled(troubled_site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Installs the engine `troubled`, for this process and those that it starts, with accidents by name and frame.

    The function returns the folder where accidents that happen once leave their marks.
    """
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.syspath_prepend(troubled_site)
    monkeypatch.setenv("PYTHONPATH", str(troubled_site), prepend=os.pathsep)
    monkeypatch.setenv("TROUBLE_MARKS", str(marks))

    def set_troubles(**frames: Sequence[int]) -> Path:
        monkeypatch.setenv("TROUBLES", json.dumps(frames))
        return marks

    set_troubles()
    return set_troubles


@pytest.fixture(scope="session")
def quick_dataset(troubled_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `QUICK_RECIPE`, made in one process without an accident; to be read only."""

    def render(out: Path) -> None:
        with pytest.MonkeyPatch.context() as monkeypatch:
            monkeypatch.syspath_prepend(troubled_site)
            summary = render_recipe(out, workers=0, text=QUICK_RECIPE)
        assert (summary.drops, summary.totals.retries) == ((), 0)

    return shared_folder(tmp_path_factory, "quick", render)


@pytest.fixture(scope="session")
def analytic_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `ANALYTIC_RECIPE`, made in one process; to be read only."""

    def render(out: Path) -> None:
        assert render_recipe(out, workers=0, text=ANALYTIC_RECIPE).drops == ()

    return shared_folder(tmp_path_factory, "analytic", render)
