"""Making a frame again: what counts as the same, and what it proves."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from datasets_manifest.storage.layout import RECORD_FILE, frame_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.writer import write_frame
from datasets_manifest.types.records import PairRecord
from droguekit.batch.frame_task import reproduce_frame
from droguekit.batch.render_dataset import describe_dataset
from render.engine import EngineUnavailableError

Change = Callable[[dict[str, Any]], None]


@pytest.fixture
def with_changed_record(tiny_dataset: Path, tmp_path: Path) -> Callable[[Change], Path]:
    """A copy of the dataset in which frame 1 has another record, with manifest and hashes to match."""

    def build(change: Change) -> Path:
        out = tmp_path / "changed"
        shutil.copytree(tiny_dataset, out)
        folder = frame_folder(out, 1)
        table = json.loads((folder / RECORD_FILE).read_text())
        change(table)
        files = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != RECORD_FILE}
        write_frame(out, PairRecord.model_validate(table), files)
        describe_dataset(Dataset(out).manifest.recipe, out, ())
        return out

    return build


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames are made again in this process, which starts the engine once."""
    monkeypatch.setattr("droguekit.batch.frame_task.run_in_own_process", lambda function: function())


def test_a_frame_made_again_is_identical(tiny_dataset: Path) -> None:
    result = reproduce_frame(tiny_dataset, 1)
    assert (result.verdict, result.differences, result.build_differences) == ("identical", (), ())


@pytest.mark.usefixtures("here")
def test_a_changed_image_is_a_difference(tiny_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "changed"
    shutil.copytree(tiny_dataset, out)
    image = frame_folder(out, 1) / "left.png"
    image.write_bytes(image.read_bytes()[:-1])
    result = reproduce_frame(out, 1)
    assert result.verdict == "different"
    assert len(result.differences) == 1
    assert "left.png" in result.differences[0]


@pytest.mark.usefixtures("here")
def test_a_last_bit_counts_on_the_same_machine(with_changed_record: Callable[[Change], Path]) -> None:
    def change(table: dict[str, Any]) -> None:
        table["pitch_deg"] *= 1 + 1e-12

    result = reproduce_frame(with_changed_record(change), 1)
    assert result.verdict == "different"
    assert [line.split(":")[0] for line in result.differences] == ["pitch_deg"]


@pytest.mark.usefixtures("here")
def test_elsewhere_numbers_may_differ_in_their_last_bits(with_changed_record: Callable[[Change], Path]) -> None:
    def change(table: dict[str, Any]) -> None:
        table["engine_version"] = "mitsuba 0.1"
        table["pitch_deg"] *= 1 + 1e-12
        table["conditions"]["monte_carlo_noise_fraction"] *= 1.01

    result = reproduce_frame(with_changed_record(change), 1)
    assert (result.verdict, result.differences) == ("equivalent", ())
    assert any("mitsuba 0.1 there" in line for line in result.build_differences)


@pytest.mark.usefixtures("here")
def test_elsewhere_labels_must_still_agree(with_changed_record: Callable[[Change], Path]) -> None:
    def change(table: dict[str, Any]) -> None:
        table["engine_version"] = "mitsuba 0.1"
        table["views"]["right"]["markers"][2]["center_proj_px"][0] += 1e-5

    result = reproduce_frame(with_changed_record(change), 1)
    assert result.verdict == "different"
    assert [line.split(":")[0] for line in result.differences] == ["views.right.markers[2].center_proj_px[0]"]


def test_a_frame_that_is_not_there_is_an_error(tiny_dataset: Path) -> None:
    with pytest.raises(ValueError, match="has no frame 17"):
        reproduce_frame(tiny_dataset, 17)


def test_a_frame_is_made_again_on_the_given_device(tiny_dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    with pytest.raises(EngineUnavailableError, match=r"^device cuda: no NVIDIA driver"):
        reproduce_frame(tiny_dataset, 1, "cuda")
