"""The networks in the package: what they say of themselves, and that they find rendered drogues."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.types.images import StereoImages
from droguekit.cli.main import DONE, run
from nav.detector.detector_registry import DEFAULT_DETECTOR, detector_names, network_file
from nav.detector.onnx_detector import OnnxDetector
from studies.detector_weights.corpora import CONES, FLAT, NEAR_CONES, ROUND

NETWORKS = [name for name in detector_names() if network_file(name) is not None]
ROOT = Path(__file__).parents[3]
# Those that do not ship with the package.
STUDY = ROOT / "studies/detector_weights"
RESULTS = STUDY / "RESULTS.md"
RECIPES = {
    "detector-weights": (str(STUDY / "more-scenes.toml"), {}),
    "detector-missed": (str(STUDY / "missed-scenes.toml"), {}),
    "detector-cones": (str(STUDY / "missed-scenes.toml"), CONES),
    "detector-near-cones": (str(STUDY / "missed-scenes.toml"), NEAR_CONES),
    "detector-round": (str(STUDY / "test.toml"), ROUND),
    "detector-flat": ("detector-small", FLAT),
}


def shipped(name: str) -> OnnxDetector:
    file = network_file(name)
    assert file is not None
    return OnnxDetector(file)


def test_the_default_is_a_network_that_ships() -> None:
    assert DEFAULT_DETECTOR in NETWORKS


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_says_where_it_comes_from(name: str) -> None:
    file, metadata = network_file(name), shipped(name).metadata
    assert file is not None and file.stat().st_size <= 12e6
    assert metadata.licence == "Apache-2.0"
    assert metadata.network["variant"] == name.removeprefix("mobile-")
    corpora = metadata.training["datasets"]
    rendered = [corpus for corpus in corpora if corpus["name"] != "photographs"]
    assert corpora[0]["name"] == "detector-train"
    assert metadata.manifest_sha256 == (corpora[0]["manifest_sha256"] if len(rendered) == 1 else "")
    # The results of the trainings name the corpora.
    page = RESULTS.read_text(encoding="utf-8")
    assert all(corpus["name"] in page and corpus["dataset_sha256"] in page for corpus in corpora)


@pytest.mark.parametrize("name", NETWORKS)
def test_no_test_scene_is_one_that_was_learned(name: str) -> None:
    # Scenes follow from a recipe's seed and their number.
    datasets = [corpus for corpus in shipped(name).metadata.training["datasets"] if corpus["name"] != "photographs"]
    recipes = (RECIPES.get(corpus["name"], (corpus["name"], {})) for corpus in datasets)
    learned = {load_recipe(recipe, changes=changes).recipe.seed for recipe, changes in recipes}
    assert load_recipe("detector-test").recipe.seed not in learned


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_finds_all_drogues_of_rendered_pairs(name: str, smoke_dataset: Path, tmp_path: Path) -> None:
    scores = tmp_path / "scores.json"
    options = ["--detector", name, "--split", "all", "--json", str(scores)]
    assert run(["benchmark", str(smoke_dataset), *options]) == DONE
    (result,) = json.loads(scores.read_text())["detectors"].values()
    assert result["overall"]["boxes"] >= 8
    assert result["overall"]["recall"] == 1 and result["overall"]["precision"] == 1


@pytest.mark.parametrize("name", NETWORKS)
def test_a_network_finds_nothing_where_nothing_is(name: str) -> None:
    # Mist, and noise as of a sensor in the dark.
    noise = np.random.default_rng(5).normal(20, 6, (480, 640, 3)).clip(0, 255).astype(np.uint8)
    mist = np.full((480, 640, 3), 150, np.uint8)
    found = shipped(name).detect(StereoImages(mist, noise, time_s=0.0, exposure_s=1e-3, encoding="gamma"))
    assert found.left is None and found.right is None
