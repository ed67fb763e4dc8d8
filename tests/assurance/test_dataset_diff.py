"""Differences between datasets: planted ones are found, and draws of one law do not differ."""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Unpack

import numpy as np
import pytest
from scipy import stats

from droguekit.assurance.dataset_diff import DatasetDiff, diff_datasets
from droguekit.assurance.law_comparison import LawDiff, compare_changes, compare_numbers, compare_words
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from tests.support.recipe_builder import RIG_160_PX, RecipeTable, between, recipe_text
from tests.support.small_datasets import rendered

BASE: RecipeTable = {
    "name": "compared",
    "seed": 4,
    "rig": RIG_160_PX,
    "frames": {"count": 20, "scenes": 5, "empty_fraction": 0.1},
    "distance": between(2.0, 6.0),
    "environment": {"sun_elevation_deg": [20, 60], "visibility_m": [10_000, 80_000]},
    "render": {"engine": "analytic"},
}


def made(folder: Path, **changes: Unpack[RecipeTable]) -> Path:
    return rendered(recipe_text(BASE, **changes), folder)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("diff") / "base")


def law(found: DatasetDiff, name: str) -> LawDiff:
    return next(each for each in (*found.labels, *found.pixels) if each.name == name)


def test_a_copy_is_the_same(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(dataset, tmp_path / "copy")
    numbers, page = tmp_path / "diff.json", tmp_path / "diff.html"
    command = ["diff", str(dataset), str(tmp_path / "copy"), "--json", str(numbers), "--html", str(page)]
    assert run(command) == DONE
    assert "the same 20 frames; the same pixels in the 20 compared" in capsys.readouterr().out
    found = DatasetDiff.model_validate_json(numbers.read_text())
    assert found.recipe == () and found.manifest == () and found.same_frames == 20
    assert all(each.p == 1.0 for each in found.pixels)
    assert page.read_text().count("<figure>") == 8


@pytest.mark.parametrize("count", [1, 3, 6])
def test_the_page_shows_each_pair_once(count: int, dataset: Path, tmp_path: Path) -> None:
    small = made(tmp_path / "small", frames={"count": count, "scenes": 1})
    page = tmp_path / "diff.html"
    run(["diff", str(dataset), str(small), "--html", str(page)])
    shown = re.findall(r"<figcaption>([AB]), pair (\d+)", page.read_text())
    assert len(shown) == len(set(shown)) == 4 + min(count, 4)
    assert shown[:2] == [("A", "0"), ("B", "0")]


def test_another_seed_of_a_recipe_does_not_differ(dataset: Path, tmp_path: Path) -> None:
    found = diff_datasets(dataset, made(tmp_path / "other", seed=5))
    few, laws = len(found.untold), len(found.labels) + len(found.pixels)
    assert 0 < few < laws
    untold = f"{few} of {laws} laws have too few scenes or pairs to tell"
    assert found.verdict == f"nothing differs that draws do not explain; {untold}"
    assert [key.key for key in found.recipe] == ["seed"]
    assert found.same_frames == 0
    # One sky for all pairs of a scene; a distance for each that has a drogue.
    assert law(found, "sun_elevation_deg").units == "scenes" and law(found, "sun_elevation_deg").counts == (5, 5)
    assert law(found, "distance_m").units == "pairs" and 30 <= sum(law(found, "distance_m").counts) < 40


@pytest.mark.slow
def test_twenty_pairs_of_seeds_do_not_differ(tmp_path: Path) -> None:
    folders = [made(tmp_path / str(seed), seed=seed) for seed in range(100, 121)]
    assert not any(diff_datasets(a, b).differs for a, b in pairwise(folders))


def test_a_shifted_law_of_distances_is_found(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = made(tmp_path / "other", seed=5, distance=between(8.0, 12.0))
    assert run(["diff", str(dataset), str(other)]) == FAULT
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert last.startswith("labels differ in") and "distance_m" in last and "sun_elevation_deg" not in last
    found = diff_datasets(dataset, other, pairs=0)
    assert {key.key for key in found.recipe} == {"seed", "distance.low_m", "distance.high_m"}
    assert law(found, "distance_m").distance == 1.0
    assert found.pixels == ()


def test_another_encoding_is_found_on_the_same_frames(dataset: Path, tmp_path: Path) -> None:
    found = diff_datasets(dataset, made(tmp_path / "other", rig=RIG_160_PX | {"encoding": "gamma"}))
    assert not any(each.differs for each in found.labels) and found.same_frames == 20 and found.same_pixels == 0
    # Encoded levels are higher in every pair.
    assert law(found, "mean_level").distance == 0.5
    assert law(found, "mean_level").differs and law(found, "noise").differs
    assert found.verdict.startswith("pixels differ in mean_level")


def test_chances_of_words_are_those_of_fisher() -> None:
    words = ["sea"] * 9 + ["town"] * 3, ["sea"] * 3 + ["town"] * 9
    found = compare_words("ground", "scenes", words, 1e-3)
    exact = stats.fisher_exact([[9, 3], [3, 9]]).pvalue
    # Four standard errors of a share of 9,999 draws.
    assert found.p == pytest.approx(exact, abs=4 * np.sqrt(exact / 9_999))
    assert found.distance == pytest.approx(0.5)


@pytest.mark.parametrize("count", [7, 8])
def test_fewer_than_eight_scenes_of_each_never_differ(count: int) -> None:
    """Of all ways to choose 8 of 16, 2 have one sample below the other: 2 / 12870 is less than 0.005 / 27."""
    low, high = np.arange(count, dtype=float), np.arange(count, dtype=float) + 100.0
    numbers = compare_numbers("altitude_m", "scenes", (low, high), 0.005 / 27)
    assert numbers.distance == 1.0 and numbers.can_differ == numbers.differs == (count == 8)
    assert not compare_words("ground", "scenes", (["sea"] * 4, ["town"] * 4), 0.005 / 27).can_differ


def test_changes_of_the_same_pairs_need_fewer_draws_than_two_samples() -> None:
    values = np.linspace(0.2, 0.8, 16)
    changed = values + 1e-6 * np.arange(1, 17)
    found = compare_changes("noise", (values, changed), 0.005 / 27)
    assert found.differs and found.distance == 0.5
    assert not compare_numbers("noise", "scenes", (values, changed), 0.005 / 27).differs
    still = compare_changes("noise", (values, values), 0.005 / 27)
    assert (still.p, still.distance, still.differs) == (1.0, 0.0, False)


def test_many_draws_are_compared_without_overflow() -> None:
    values = np.random.default_rng(2).normal(size=(2, 50_000))
    assert compare_numbers("distance_m", "pairs", (values[0], values[1]), 1e-4).can_differ


def test_what_cannot_be_told_is_said(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["diff", str(dataset), str(dataset), "--pairs", "0"]) == DONE
    told = capsys.readouterr().out
    assert "too few scenes or pairs to tell a difference: altitude_m" in told
    assert told.strip().endswith("the same 20 frames; pixels were not compared")


def test_two_datasets_too_small_to_tell_do_not_pass_for_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two pairs each, near and far: as different as they can be, and yet draws explain it."""
    few = {"count": 2, "scenes": 1}
    near = made(tmp_path / "near", frames=few, distance=between(2.0, 3.0))
    far = made(tmp_path / "far", frames=few, distance=between(20.0, 30.0))
    assert run(["diff", str(near), str(far)]) == FAULT
    assert capsys.readouterr().out.strip().endswith("too few scenes or pairs to tell any difference")
    assert run(["diff", str(near), str(near)]) == DONE
    assert "the same 2 frames; the same pixels" in capsys.readouterr().out


def test_more_pairs_than_there_are_is_all_of_them(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["diff", str(dataset), str(dataset), "--pairs", "9" * 20]) == DONE
    assert "the same pixels in the 20 compared" in capsys.readouterr().out


def test_wrong_input_is_named(dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["diff", str(dataset), str(tmp_path / "none")]) == WRONG_INPUT
    assert "none" in capsys.readouterr().err
    assert run(["diff", str(dataset), str(dataset), "--pairs", "-1"]) == WRONG_INPUT
    assert "--pairs: must not be negative, got -1" in capsys.readouterr().err
    shutil.copytree(dataset, tmp_path / "damaged")
    record = next((tmp_path / "damaged" / "frames").glob("*/record.json"))
    record.write_text(json.dumps({}))
    assert run(["diff", str(dataset), str(tmp_path / "damaged")]) == WRONG_INPUT
