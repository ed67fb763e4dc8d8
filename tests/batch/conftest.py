"""A recipe of four tiny pairs, and the dataset that one undisturbed run makes of it."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from datasets_manifest.layout import EVENTS_FILE
from datasets_manifest.recipe import parse_recipe
from droguekit.batch.local import RunSummary, render_dataset
from droguekit.batch.progress import PlainProgress

TINY_RECIPE = """
name = "tiny"
seed = 5
[rig]
preset = "rgb-ideal"
width_px = 320
height_px = 240
focal_px = 533.0
[frames]
count = 4
scenes = 2
[distance]
law = "log-uniform"
low_m = 3.0
high_m = 12.0
[render]
samples_per_px = 1
surround_samples_per_px = 1
max_depth = 2
[split]
train = 0.5
test = 0.5
"""

Make = Callable[..., RunSummary]
Hashes = Callable[[Path], dict[str, str]]


def _make(out: Path, frames: Sequence[int] = range(4), workers: int = 1, text: str = TINY_RECIPE) -> RunSummary:
    return render_dataset(parse_recipe(text), text, out, frames, workers, PlainProgress(io.StringIO()))


@pytest.fixture(scope="session")
def tiny_recipe() -> str:
    """Four pairs of 320 x 240 pixels, as TOML."""
    return TINY_RECIPE


@pytest.fixture(scope="session")
def make() -> Make:
    """Renders frames of a recipe, without a word: `make(out, frames, workers, text)`."""
    return _make


@pytest.fixture(scope="session")
def hashes() -> Hashes:
    """Hashes of a dataset's files by their path, without the events, which tell of times and hosts."""
    return lambda dataset: {
        str(path.relative_to(dataset)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(dataset.rglob("*"))
        if path.is_file() and path.name != EVENTS_FILE
    }


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `tiny_recipe`, made by one worker in ascending order; to be read only."""
    out = tmp_path_factory.mktemp("tiny") / "dataset"
    assert _make(out).drops == ()
    return out
