"""Recipes that move to another folder and still find their files."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from datasets_manifest.recipe.file_names import move_file_names
from datasets_manifest.recipe.recipe import Recipe, parse_recipe
from tests.support.recipe_builder import recipe_text, stations

SKY = Path(__file__).parents[1] / "support" / "plain_sky.hdr"
DROGUE = 'name = "own"\nmarker_count = 6\nmarker_ring_radius_m = 0.267\n'


@pytest.fixture
def before(tmp_path: Path) -> Path:
    folder = tmp_path / "before"
    (folder / "parts").mkdir(parents=True)
    (folder / "own.toml").write_text(DROGUE)
    (folder / "parts" / "rig.toml").write_text(
        'preset = "rgb-ideal"\nwidth_px = 160\nheight_px = 120\nfocal_px = 266.0\n'
    )
    shutil.copy(SKY, folder / "sky.hdr")
    return folder


def contents(recipe: Recipe) -> dict[str, Any]:
    """All but the names of environment maps, whose hashes stay."""
    table = recipe.model_dump(mode="json")
    for part in (table, *table["families"]):
        assert len(part["environment"]["map"].pop("path")) > 0
    return table


@pytest.mark.parametrize("one_map", [{"file": "sky.hdr", "cd_m2_per_unit": 2.0}, "sky.hdr"])
def test_a_moved_recipe_reads_the_same_files(before: Path, tmp_path: Path, one_map: object) -> None:
    after = tmp_path / "some" / "where"
    after.mkdir(parents=True)
    target = {"variants": [{"drogue": "own.toml"}, {"drogue": "red-8"}, {"drogue": str(before / "own.toml")}]}
    text = recipe_text(
        name="moved",
        frames={"count": 1},
        distance=stations(5.0),
        drogue="own.toml",
        rig="parts/rig.toml",
        environment={"map": "sky.hdr"},
        target=target,
        families=[{"name": "one", "environment": {"map": one_map}, "target": target}, {"name": "other"}],
    )
    table: Any = tomlkit.parse(text)
    move_file_names(table, before, after)
    moved = tomlkit.dumps(table)
    assert contents(parse_recipe(moved, after)) == contents(parse_recipe(text, before))
    move_file_names(table, after, before)
    assert tomllib.loads(tomlkit.dumps(table)) == tomllib.loads(text)


def test_names_of_presets_stay(tmp_path: Path) -> None:
    table = {"drogue": "red-8", "rig": {"preset": "rgb-ideal"}, "target": {"variants": [{"drogue": "red-5"}]}}
    moved = {"drogue": "red-8", "rig": {"preset": "rgb-ideal"}, "target": {"variants": [{"drogue": "red-5"}]}}
    move_file_names(moved, tmp_path, tmp_path / "other")
    assert moved == table
