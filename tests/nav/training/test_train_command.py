from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from datasets_manifest.storage.reader import Dataset
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from tests.support.recipe_builder import RecipeTable, between, recipe_text

BASE: RecipeTable = {
    "name": "two-scenes",
    "description": "Four small pairs.",
    "rig": {"preset": "rgb-ideal", "width_px": 320, "height_px": 240, "focal_px": 300.0},
    "frames": {"count": 4, "scenes": 2},
    "distance": between(2.0, 10.0, "log-uniform"),
    "render": {"engine": "analytic"},
    "split": {"train": 0.5, "val": 0.5, "test": 0.0},
}
RECIPE = recipe_text(BASE)


@pytest.fixture(autouse=True)
def own_wait_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    # The command sets it for its process where nobody did; other tests shall not find it.
    monkeypatch.setenv("OMP_WAIT_POLICY", "PASSIVE")


def test_a_recipe_becomes_a_detector(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe, out = tmp_path / "recipe.toml", tmp_path / "out"
    recipe.write_text(RECIPE)
    size = ["--size", "64x96", "--final-size", "96x128", "--image-passes", "16", "--variant", "s", "--threads", "1"]
    command = ["train", str(recipe), "--out", str(out), *size, "--views", "one", "--workers", "0"]
    assert run(command) == DONE
    told = capsys.readouterr()
    assert "val: AP50" in told.out and "detector.onnx" in told.out and "test:" not in told.out
    assert (out / "detector.onnx").stat().st_size > 0 and (out / "datasets" / "two-scenes" / "manifest.json").is_file()
    assert "at 64x96" in told.err and "at 96x128" in told.err
    assert run([*command, "--no-mosaic"]) == WRONG_INPUT
    # Known before it looks at the rendered pairs again.
    refused = capsys.readouterr().err.splitlines()[-1]
    assert "belongs to a training that differs in mosaic;" in refused


def test_pairs_damaged_after_their_images_were_cached_do_not_cost_a_finished_training(
    split_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    shutil.copytree(split_dataset, data)
    size = ["--size", "96x128", "--image-passes", "4", "--variant", "s", "--threads", "1"]
    command = ["train", str(data), "--out", str(out), *size]
    assert run(command) == DONE
    damaged = [next(e.frame_index for e in Dataset(data).manifest.frames if e.split == of) for of in ("val", "test")]
    for number in damaged:
        (data / "frames" / f"{number:06d}" / "left.png").write_bytes(b"damaged")
    for is_cached in (True, False):
        for file in ("detector.onnx", "last.onnx"):
            (out / file).unlink()
        if not is_cached:
            shutil.rmtree(out / "cache")
        capsys.readouterr()
        assert run(command) == FAULT
        told = capsys.readouterr()
        assert "2 pairs have no result by a fault, first pair" in told.err and "left.png" in told.err
        assert "val: AP50" in told.out and "test: AP50" in told.out
        assert (out / "detector.onnx").is_file() and (out / "last.onnx").is_file()
    # The weights would be others with another pair to train on.
    trained = next(entry.frame_index for entry in Dataset(data).manifest.frames if entry.split == "train")
    (data / "frames" / f"{trained:06d}" / "left.png").write_bytes(b"damaged")
    shutil.rmtree(out / "cache")
    assert run(command) == WRONG_INPUT
    assert "belongs to a training that differs in datasets" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (recipe_text(BASE, split={"train": 0.0, "val": 1.0}), [], "has no split to train on"),
        (RECIPE, ["--device", "cuda"], "torch finds no CUDA device"),
    ],
    ids=["no split", "no device"],
)
def test_nothing_is_rendered_for_a_training_that_cannot_be(
    text: str, options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if "cuda" in options and torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    recipe, out = tmp_path / "recipe.toml", tmp_path / "out"
    recipe.write_text(text)
    assert run(["train", str(recipe), "--out", str(out), *options]) == WRONG_INPUT
    assert message in capsys.readouterr().err and not out.exists()


def test_two_recipes_of_one_name_are_refused_before_any_is_rendered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, out = tmp_path / "first.toml", tmp_path / "second.toml", tmp_path / "out"
    first.write_text(RECIPE)
    second.write_text(recipe_text(BASE, seed=9))
    assert run(["train", str(first), str(second), "--out", str(out)]) == WRONG_INPUT
    assert f"error: {second}: has the name of {first}, 'two-scenes'" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["no-such-recipe"], "no-such-recipe"),
        ([".", "--size", "480"], "size: must be HEIGHTxWIDTH"),
        ([".", "--size", "100x100"], "size_px: must be multiples of 32 px"),
        ([".", "--image-passes", "0"], "image_passes:"),
        ([".", "--settings", "none.toml"], "none.toml: cannot be read"),
        (["nav", "--start-from", "none.pt"], "none.pt: is missing"),
        # The network is that of the weights, and what comes next is wrong.
        (["nav", "--start-from", "mobile-s"], "manifest.json: is missing"),
        (["nav", "--start-from", "mobile-s", "--variant", "l"], "holds weights of another network, s, eca, asff;"),
        (["nav"], "manifest.json: is missing"),
    ],
)
def test_wrong_input_is_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nav").mkdir()
    assert run(["train", *arguments, "--out", str(tmp_path / "out")]) == WRONG_INPUT
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
