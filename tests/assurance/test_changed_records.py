"""Commands that take records as truth, on a record that was changed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datasets_manifest.storage.layout import RECORD_FILE, frame_folder
from datasets_manifest.types.estimates import NoFix, write_estimates
from droguekit.cli.main import WRONG_INPUT, run
from tests.support.changed_records import with_another_pose
from tests.support.recipe_builder import RIG_160_PX, between, recipe_text
from tests.support.small_datasets import rendered


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of which one record was changed, estimates of it and a photograph."""
    folder = tmp_path_factory.mktemp("changed")
    frames = {"count": 4, "scenes": 2}
    text = recipe_text(
        name="changed", rig=RIG_160_PX, frames=frames, distance=between(3.0, 6.0), render={"engine": "analytic"}
    )
    record = frame_folder(rendered(text, folder / "data"), 2) / RECORD_FILE
    record.write_bytes(with_another_pose(record.read_bytes()))
    failures = [NoFix(frame_index=index, method="none", reason="none") for index in range(4)]
    write_estimates(folder / "poses.jsonl", failures)
    (folder / "photographs").mkdir()
    Image.fromarray(np.zeros((48, 64, 3), np.uint8)).save(folder / "photographs" / "black.png")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["coverage", "data"],
        ["mine", "data", "--estimates", "poses.jsonl", "--out", "harder.toml"],
        ["diff", "data", "data"],
        ["real-check", "photographs", "--known", "data"],
    ],
    ids=lambda words: words[0],
)
def test_a_changed_record_is_no_truth(
    words: list[str], place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(place)
    assert run(words) == WRONG_INPUT
    assert "record.json: was changed: its hash differs from the recorded one" in capsys.readouterr().err
    assert not Path("harder.toml").exists()
