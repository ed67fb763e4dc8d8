"""A finished training is used again, and only for what it was made of."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from datasets_manifest.storage.reader import Dataset
from nav.training.training_run import LAST_ONNX_FILE, ONNX_FILE, RESULT_FILE
from studies.short_training import train_briefly
from tests.support.recipe_builder import recipe_text
from tests.support.small_datasets import SINGLE_PAIRS, rendered


def test_a_finished_training_is_used_again_only_for_its_own_pictures_passes_and_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    corpus, other = (
        rendered(recipe_text(SINGLE_PAIRS, seed=seed, frames={"count": 1}), tmp_path / f"corpus-{seed}")
        for seed in (2, 3)
    )
    out, runs = tmp_path / "training", list[tuple[object, ...]]()
    monkeypatch.setattr("studies.short_training.run_droguekit", lambda *words, log: runs.append(words))
    network = train_briefly(corpus, out, tmp_path / "cache", 16, 7)
    assert network == out / ONNX_FILE and len(runs) == 1
    assert runs[0][:2] == ("train", corpus) and {16, 7, "320x416"} <= set(runs[0])
    # As a training leaves it at its end.
    out.mkdir()
    (out / LAST_ONNX_FILE).touch()
    pictures = [{"dataset_sha256": Dataset(corpus).manifest.dataset_sha256}]
    result = {"datasets": pictures, "settings": {"image_passes": 16, "seed": 7}}
    (out / RESULT_FILE).write_text(json.dumps(result))
    assert train_briefly(corpus, out, tmp_path / "cache", 16, 7) == network
    assert len(runs) == 1
    for changed in ((other, 16, 7), (corpus, 24, 7), (corpus, 16, 8)):
        with pytest.raises(ValueError, match="training: holds a training of other pictures, passes or seed"):
            train_briefly(changed[0], out, tmp_path / "cache", *changed[1:])
    assert len(runs) == 1
