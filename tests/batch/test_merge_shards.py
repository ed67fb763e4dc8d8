"""Shards made apart and joined are the dataset that one run makes; shards that do not fit are refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from datasets_manifest.storage import layout
from datasets_manifest.storage.manifest import Drop, build_manifest, read_manifest, with_build, write_manifest
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from labelgen.validation.dataset_checks import validate_dataset
from render.version import RENDER_VERSION
from scenes.sampler import split_of_scenes
from tests.support.batch_datasets import ANALYTIC_RECIPE, file_hashes, render_recipe


@pytest.fixture(scope="module")
def recipe_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recipe") / "quick.toml"
    path.write_text(ANALYTIC_RECIPE)
    return path


@pytest.fixture(scope="module")
def whole(analytic_dataset: Path) -> Path:
    """The same pairs by one run; to be read only."""
    return analytic_dataset


@pytest.fixture(scope="module")
def made_shards(tmp_path_factory: pytest.TempPathFactory, recipe_file: Path) -> tuple[Path, ...]:
    folder = tmp_path_factory.mktemp("shards")
    for number in range(3):
        out = ["--out", str(folder / str(number)), "--shard", f"{number}/3", "--workers", "0"]
        assert run(["render", str(recipe_file), *out]) == DONE
    return tuple(folder / str(number) for number in range(3))


@pytest.fixture
def shards(made_shards: tuple[Path, ...], tmp_path: Path) -> tuple[Path, ...]:
    """Copies that a test may damage."""
    for shard in made_shards:
        shutil.copytree(shard, tmp_path / shard.name)
    return tuple(tmp_path / shard.name for shard in made_shards)


def merge(out: Path, *shards: Path) -> int:
    return run(["merge", str(out), *map(str, shards)])


def test_shards_are_the_dataset_that_one_run_makes(made_shards: tuple[Path, ...], whole: Path, tmp_path: Path) -> None:
    assert [layout.frame_indices(shard) for shard in made_shards] == [[0, 3, 6], [1, 4, 7], [2, 5]]
    assert merge(tmp_path / "out", *made_shards[::-1]) == DONE
    assert file_hashes(tmp_path / "out") == file_hashes(whole)
    assert validate_dataset(tmp_path / "out").passed


def test_a_merge_goes_on_where_it_stopped(
    made_shards: tuple[Path, ...], whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert merge(out, *made_shards) == DONE
    shutil.rmtree(layout.frame_folder(out, 4))
    image = layout.frame_folder(out, 5) / "left.png"
    image.write_bytes(image.read_bytes()[:-1])
    capsys.readouterr()
    assert merge(out, *made_shards) == DONE
    assert "joined 2 pairs" in capsys.readouterr().out
    assert file_hashes(out) == file_hashes(whole)


def test_a_damaged_frame_that_all_shards_left_out_is_left_out(
    shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert merge(out, *shards) == DONE
    manifest = read_manifest(shards[1])
    shutil.rmtree(layout.frame_folder(shards[1], 4))
    drops = [Drop(frame_index=4, reason="it was too hard")]
    splits = split_of_scenes(manifest.recipe)
    write_manifest(shards[1], build_manifest(shards[1], manifest.recipe, RENDER_VERSION, splits, drops))
    image = layout.frame_folder(out, 4) / "left.png"
    image.write_bytes(image.read_bytes()[:-1])
    assert merge(out, *shards) == FAULT
    assert "frame 4 is missing: it was too hard" in capsys.readouterr().err
    assert layout.frame_indices(out) == [0, 1, 2, 3, 5, 6, 7]
    assert validate_dataset(out).passed


def test_missing_frames_are_named(
    made_shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert merge(tmp_path / "out", *made_shards[:2]) == WRONG_INPUT
    assert "2 of 8 frames are in none of them: 2, 5; run the commands of their shards" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_damaged_frame_is_not_joined(
    shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = layout.frame_folder(shards[1], 1) / "right.png"
    image.write_bytes(image.read_bytes() + b"\0")
    assert merge(tmp_path / "out", *shards) == WRONG_INPUT
    assert "000001/right.png: was changed" in capsys.readouterr().err


def test_a_recipe_that_is_no_text_is_named(
    shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (shards[0] / layout.RECIPE_FILE).write_bytes(b"# \xff")
    assert merge(tmp_path / "out", *shards) == WRONG_INPUT
    assert f"error: {shards[0]}/recipe.toml: is no UTF-8 text: invalid start byte at byte 2" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_shard_of_another_recipe_is_refused(
    made_shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    render_recipe(tmp_path / "other", [2, 5], workers=0, text=ANALYTIC_RECIPE.replace("seed = 5", "seed = 6"))
    assert merge(tmp_path / "out", *made_shards[:2], tmp_path / "other") == WRONG_INPUT
    assert "other: is of another recipe than" in (told := capsys.readouterr().err)
    assert "they differ in seed" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("what", ["numpy", "processor features"])
def test_a_shard_made_with_something_else_is_refused(
    what: str, shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = read_manifest(shards[2])
    software, features = dict(manifest.software), list(manifest.cpu_features)
    if what == "numpy":
        software["numpy"] = "0.9"
    else:
        features.append("AVX4096")
    write_manifest(shards[2], with_build(manifest, software, features))
    assert merge(tmp_path / "out", *shards) == WRONG_INPUT
    told = capsys.readouterr().err
    assert f"was made with {what} {'0.9' if what == 'numpy' else 'AVX4096'}" in told
    assert not (tmp_path / "out").exists()


def test_two_frames_of_one_index_are_refused(
    shards: tuple[Path, ...], made_shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = read_manifest(shards[0]).model_dump(mode="json")
    from datasets_manifest.storage.manifest import Manifest, dataset_sha256

    table["frames"][0]["record_sha256"] = "0" * 64
    manifest = Manifest.model_construct(**read_manifest(shards[0]).__dict__)
    hashes = [entry["record_sha256"] for entry in table["frames"]]
    changed = manifest.model_copy(
        update={
            "frames": tuple(type(manifest.frames[0]).model_validate(entry) for entry in table["frames"]),
            "dataset_sha256": dataset_sha256(manifest.recipe, hashes),
        }
    )
    write_manifest(shards[0], with_build(changed, changed.software, changed.cpu_features))
    assert merge(tmp_path / "out", *shards, made_shards[0]) == WRONG_INPUT
    assert "its frame 0 differs from that of" in capsys.readouterr().err


def test_frames_of_another_build_in_the_dataset_are_refused(
    shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert merge(out, *shards) == DONE
    manifest = read_manifest(out)
    write_manifest(out, with_build(manifest, {**manifest.software, "numpy": "0.9"}, manifest.cpu_features))
    before = file_hashes(out)
    assert merge(out, *shards) == WRONG_INPUT
    told = capsys.readouterr().err
    assert "out: was made with numpy 0.9, but" in told and "differ: merge into a new folder" in told
    assert file_hashes(out) == before


@pytest.mark.parametrize("is_listed", [True, False])
def test_a_kept_frame_that_differs_from_its_shard_is_refused(
    is_listed: bool, shards: tuple[Path, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert merge(out, *shards) == DONE
    record_file = layout.frame_folder(out, 3) / layout.RECORD_FILE
    record_file.write_text(record_file.read_text().replace('"family":"clear"', '"family":"foggy"'))
    manifest = read_manifest(out)
    listed = out if is_listed else tmp_path / "empty"
    splits = split_of_scenes(manifest.recipe)
    write_manifest(out, build_manifest(listed, manifest.recipe, RENDER_VERSION, splits))
    capsys.readouterr()
    assert merge(out, *shards) == WRONG_INPUT
    assert f"out: its frame 3 differs from that of {shards[0]}; merge into a new folder" in capsys.readouterr().err


@pytest.mark.parametrize(("shard", "message"), [("3/3", "i from 0 to n - 1"), ("1", "i/n"), ("8/9", "none of the 8")])
def test_wrong_shards(
    shard: str, message: str, recipe_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["render", str(recipe_file), "--out", str(tmp_path / "out"), "--shard", shard]) == WRONG_INPUT
    assert message in capsys.readouterr().err
