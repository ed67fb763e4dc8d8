"""Recipes that follow failures, against shares worked out by hand and against the frames that they draw."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import parse_recipe
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import NoFix, PoseEstimate, write_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.assurance.hard_example_mining import MinedRecipe, MiningChoices, mine_recipe
from droguekit.cli.main import DONE, WRONG_INPUT, run
from geometry.se3 import RigidTransform
from scenes.drogue_appearance import drogue_of_scene
from scenes.sampler import recipe_of_scene, sample_left_from_drogue
from tests.support.recipe_builder import RIG_160_PX, between, recipe_text
from tests.support.small_datasets import rendered

PRIOR = 4.0


def text_of(**changes: Any) -> str:
    variants = [{"drogue": "red-8", "weight": 3}, {"drogue": "red-5"}]
    families = [
        {"name": "clear", "weight": 3, "environment": {"sun_elevation_deg": [30, 60]}},
        {"name": "low-sun", "environment": {"sun_elevation_deg": [5, 10]}},
    ]
    given = {
        "name": "mined",
        "seed": 4,
        "rig": RIG_160_PX,
        "frames": {"count": 40, "scenes": 20, "empty_fraction": 0.1},
        "distance": between(2.0, 32.0, "log-uniform"),
        "target": {"variants": variants},
        "families": families,
        "render": {"engine": "analytic"},
    }
    return recipe_text(**(given | changes))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(text_of(), tmp_path_factory.mktemp("mined") / "dataset")


def is_hard(record: PairRecord) -> bool:
    """Planted: what fails is far away and looked at in low sun."""
    distance_m = record.conditions.distance_m
    return distance_m is not None and distance_m > 8.0 and record.conditions.family == "low-sun"


def write_failures(dataset: Path, out: Path, hard: Callable[[PairRecord], bool] = is_hard) -> Path:
    source = Dataset(dataset)
    answers: list[PoseEstimate | NoFix] = []
    for record in source.records():
        pose = record.left_from_drogue
        if pose is None:
            continue
        moved = RigidTransform(pose.rotation, pose.translation_m * (1.1 if hard(record) else 1.001))
        answers.append(
            PoseEstimate(
                frame_index=record.frame_index,
                time_s=record.frame.time_s,
                method="planted",
                left_from_drogue=moved,
                covariance=np.eye(6) * 1e-4,
                modes=(),
                features=(),
            )
        )
    write_estimates(out, answers)
    return out


def mined_of(dataset: Path, folder: Path, **choices: Any) -> MinedRecipe:
    return mine_recipe(
        dataset, Path("harder.toml"), MiningChoices(**choices), write_failures(dataset, folder / "poses.jsonl")
    )


def test_shares_are_what_the_objective_says(dataset: Path, tmp_path: Path) -> None:
    mined = mined_of(dataset, tmp_path, kept=0.4, distance_bins=4)
    records = [record for record in Dataset(dataset).records() if record.left_from_drogue is not None]
    laws = {law.of: law for law in mined.laws}
    assert set(laws) == {"families", "distance", "drogues"}
    mean = sum(is_hard(record) for record in records) / len(records)
    keys = {
        "families": lambda record: record.conditions.family,
        "distance": lambda record: int(np.log2(record.conditions.distance_m / 2.0)),
        "drogues": lambda record: record.frame.drogue.name,
    }
    names = {"families": ["clear", "low-sun"], "distance": [0, 1, 2, 3], "drogues": ["red-8", "red-5"]}
    before = {"families": [0.75, 0.25], "distance": [0.25] * 4, "drogues": [0.75, 0.25]}
    for law, key in keys.items():
        cases = Counter(key(record) for record in records)
        failures = Counter(key(record) for record in records if is_hard(record))
        fraction = np.array([(failures[name] + PRIOR * mean) / (cases[name] + PRIOR) for name in names[law]])
        share = np.array(before[law])
        expected = 0.4 * share + 0.6 * share * fraction / (share @ fraction)
        np.testing.assert_allclose([place.after for place in laws[law].bins], expected, rtol=1e-12)
        assert sum(place.failures for place in laws[law].bins) == sum(is_hard(record) for record in records) > 3


@pytest.mark.slow
def test_a_familys_own_drogues_have_their_own_cases(tmp_path: Path) -> None:
    variants = [{"drogue": "red-8"}, {"drogue": "red-5"}]
    families = [{"name": "clear"}, {"name": "hazy"}, {"name": "own", "target": {"variants": variants}}]
    frames = {"count": 40, "scenes": 40, "empty_fraction": 0.0}
    dataset = rendered(text_of(target={"variants": variants}, families=families, frames=frames), tmp_path / "dataset")

    def fails(record: PairRecord) -> bool:
        return record.conditions.family == "own" and record.frame.drogue.name == "red-8"

    poses = write_failures(dataset, tmp_path / "poses.jsonl", fails)
    mined = mine_recipe(dataset, Path("harder.toml"), MiningChoices(), poses)
    drawn = Counter(
        (record.conditions.family == "own", record.frame.drogue.name) for record in Dataset(dataset).records()
    )
    laws = {law.of: {place.name: place for place in law.bins} for law in mined.laws}
    assert set(laws) == {"families", "distance", "drogues", "drogues of own"}
    for of, is_own in (("drogues", False), ("drogues of own", True)):
        assert {name: place.cases for name, place in laws[of].items()} == {
            name: drawn[is_own, name] for name in ("red-8", "red-5")
        }
    assert laws["drogues of own"]["red-8"].failures == drawn[True, "red-8"] > 0
    assert [place.after for place in laws["drogues"].values()] == [0.5, 0.5]
    assert laws["drogues of own"]["red-8"].after > 0.55


def test_drogues_that_no_family_takes_keep_their_law(tmp_path: Path) -> None:
    variants = [{"drogue": "red-8"}, {"drogue": "red-5"}]
    families = [{"name": name, "target": {"variants": variants}} for name in ("clear", "hazy")]
    frames = {"count": 8, "scenes": 8, "empty_fraction": 0.0}
    dataset = rendered(text_of(target={"variants": variants}, families=families, frames=frames), tmp_path / "dataset")
    poses = write_failures(dataset, tmp_path / "poses.jsonl", lambda record: record.frame_index < 4)
    mined = mine_recipe(dataset, Path("harder.toml"), MiningChoices(), poses)
    assert [law.of for law in mined.laws] == ["families", "distance", "drogues of clear", "drogues of hazy"]


def test_the_new_recipe_draws_what_it_says(dataset: Path, tmp_path: Path) -> None:
    mined = mined_of(dataset, tmp_path, kept=0.3, distance_bins=4, count=4000)
    recipe = parse_recipe(mined.text)
    assert (recipe.name, recipe.seed, recipe.frames.count, recipe.frames.scenes) == ("harder", 5, 4000, 2000)
    scenes = [recipe_of_scene(recipe, scene_id) for scene_id in range(2000)]
    drogues = [drogue_of_scene(own, scene_id).name for scene_id, own in enumerate(scenes)]
    poses = [sample_left_from_drogue(recipe, index) for index in range(0, 4000, 4)]
    far = np.mean([pose.translation_m[2] > 8.0 for pose in poses if pose is not None])
    low = np.mean([own.family == "low-sun" for own in scenes])
    laws = {law.of: {place.name: place.after for place in law.bins} for law in mined.laws}
    # Three binomial deviations of 900 frames, and of 2000 scenes.
    assert far == pytest.approx(sum(list(laws["distance"].values())[2:]), abs=0.05)
    assert low == pytest.approx(laws["families"]["low-sun"], abs=0.035)
    assert np.mean([name == "red-5" for name in drogues]) == pytest.approx(laws["drogues"]["red-5"], abs=0.035)
    assert far > 0.65 and low > 0.45


def test_keeping_everything_keeps_the_laws_and_mining_again_goes_on(dataset: Path, tmp_path: Path) -> None:
    same = mined_of(dataset, tmp_path, kept=1.0)
    assert all(place.after == pytest.approx(place.before, rel=1e-12) for law in same.laws for place in law.bins)
    first = mined_of(dataset, tmp_path, kept=0.5, distance_bins=4, count=24)
    assert first.text == mined_of(dataset, tmp_path, kept=0.5, distance_bins=4, count=24).text
    again = rendered(first.text, tmp_path / "again")
    second = mined_of(again, tmp_path, distance_bins=7)
    law = {law.of: law for law in second.laws}["distance"]
    written = tomllib.loads(first.text)["distance"]
    assert len(law.bins) == 4
    np.testing.assert_allclose([place.before for place in law.bins], np.array(written["weights"]) / 4, atol=1e-4)


def test_bins_of_a_narrow_range_stay_apart(tmp_path: Path) -> None:
    """Three digits name all edges from 8 to 8.005 m alike."""
    narrow = text_of(
        distance=between(8.0, 8.005), frames={"count": 12, "scenes": 6, "empty_fraction": 0.0}, families=[]
    )
    dataset = rendered(narrow, tmp_path / "narrow")
    poses = tmp_path / "poses.jsonl"
    write_failures(dataset, poses, hard=lambda record: record.frame_index % 2 == 0)
    mined = mine_recipe(dataset, Path("harder.toml"), MiningChoices(distance_bins=8), poses)
    (law,) = (law for law in mined.laws if law.of == "distance")
    assert len({place.name for place in law.bins}) == len(law.bins) == 8
    recipe = parse_recipe(mined.text)
    assert recipe.distance.weights is not None and len(recipe.distance.weights) == 8
    assert sum(place.cases for place in law.bins) == 12


def test_the_command_writes_a_recipe_and_tells_the_shares(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses, out = write_failures(dataset, tmp_path / "poses.jsonl"), tmp_path / "new" / "harder.toml"
    assert run(["mine", str(dataset), "--estimates", str(poses), "--out", str(out)]) == DONE
    told = capsys.readouterr().out
    assert "low-sun" in told and "25.0 % ->" in told and f"wrote {out}" in told
    assert out.read_text().startswith("# Mined from mined (")
    assert parse_recipe(out.read_text(), out.parent).distance.weights is not None


def test_a_recipe_in_another_folder_finds_its_drogue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "own.toml").write_text('name = "own"\nmarker_count = 6\nmarker_ring_radius_m = 0.267\n')
    old, out = tmp_path / "old" / "old.toml", tmp_path / "new" / "harder.toml"
    old.write_text(text_of(drogue="own.toml", target={}))
    dataset = tmp_path / "dataset"
    assert run(["render", str(old), "--out", str(dataset)]) == DONE
    poses = write_failures(dataset, tmp_path / "poses.jsonl")
    assert run(["mine", str(dataset), "--estimates", str(poses), "--recipe", str(old), "--out", str(out)]) == DONE
    assert parse_recipe(out.read_text(), out.parent).drogue == parse_recipe(old.read_text(), old.parent).drogue
    capsys.readouterr()


@pytest.mark.slow
def test_a_dataset_of_another_engine_can_be_mined(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, out, dataset = (tmp_path / name for name in ("old.toml", "harder.toml", "dataset"))
    old.write_text(text_of(render={"engine": "mitsuba"}))
    assert run(["render", str(old), "--engine", "analytic", "--out", str(dataset)]) == DONE
    poses = write_failures(dataset, tmp_path / "poses.jsonl")
    assert run(["mine", str(dataset), "--estimates", str(poses), "--out", str(out)]) == DONE
    assert parse_recipe(out.read_text()).render.engine == "mitsuba"
    capsys.readouterr()


def test_a_dataset_without_a_case_says_so(tmp_path: Path) -> None:
    frames = {"count": 4, "scenes": 2, "empty_fraction": 1.0}
    dataset, boxes = rendered(text_of(frames=frames), tmp_path / "dataset"), tmp_path / "boxes.json"
    boxes.write_text("[]")
    with pytest.raises(ValueError, match="no pair has a drogue that boxes is to find; there is nothing to learn from"):
        mine_recipe(dataset, Path("harder.toml"), MiningChoices(), detections=[boxes])


def test_what_cannot_be_mined_says_why(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses, out = write_failures(dataset, tmp_path / "poses.jsonl"), tmp_path / "harder.toml"
    plain = ["mine", str(dataset), "--out", str(out)]
    for extra, words in (
        ([], "give --estimates or --detections"),
        (["--estimates", str(poses), "--method", "other"], "there are planted"),
        (["--estimates", str(poses), "--kept", "1.5"], "--kept: must be from 0 to 1"),
        (["--estimates", str(poses), "--distance-bins", "0"], "--distance-bins: must be from 1 to 100"),
        (["--estimates", str(poses), "--position-error", "0.9"], "solves every case"),
    ):
        assert run([*plain, *extra]) == WRONG_INPUT
        assert words in capsys.readouterr().err
    capital = tmp_path / "Harder_2.toml"
    assert run(["mine", str(dataset), "--out", str(capital)]) == WRONG_INPUT
    assert "--out: the file names the recipe" in (told := capsys.readouterr().err) and "got Harder_2.toml" in told
    changed = tmp_path / "other.toml"
    changed.write_text(text_of(distance=between(2.0, 30.0)))
    assert run([*plain, "--estimates", str(poses), "--recipe", str(changed)]) == WRONG_INPUT
    assert "other.toml: differs in distance.law, " in capsys.readouterr().err
    assert not out.exists()
