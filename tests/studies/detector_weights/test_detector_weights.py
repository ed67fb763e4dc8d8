"""Scores of a training of shipped weights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from nav.detector.detector_registry import network_file
from nav.detector.onnx_detector import OnnxDetector
from nav.training.training_settings import build_settings, differing_settings
from scenes.sampler import scene_of_frame
from studies.detector_weights.__main__ import score_lines
from studies.detector_weights.corpora import MORE_SCENES, TRAININGS, datasets, frames_of_first_scenes


def test_the_second_corpus_has_whole_scenes() -> None:
    recipe = load_recipe(str(Path(__file__).parents[3] / "studies" / "detector_weights" / "more-scenes.toml"))
    frames = frames_of_first_scenes(recipe, MORE_SCENES)
    scenes = [scene_of_frame(recipe, index) for index in frames]
    assert len(set(scenes)) == MORE_SCENES
    assert {scenes.count(scene) for scene in scenes} == {recipe.frames.count // recipe.frames.scenes}


@pytest.mark.parametrize("variant", ["l", "s"])
def test_the_shipped_weights_are_those_of_the_last_training(variant: str) -> None:
    last, network = TRAININGS[variant][-1], network_file(f"mobile-{variant}")
    assert network is not None
    learned = OnnxDetector(network).metadata.training
    own = datasets(variant)
    names = [own[corpus][0].recipe.name for corpus in last.corpora]
    assert [corpus["name"] for corpus in learned["datasets"]] == [*names, "photographs"]
    settings = build_settings(last.settings(variant), {}).model_dump(mode="json")
    # Where the training ran, and the weights that it began from; a default that has changed since is told by its value.
    assert set(differing_settings(settings, learned["settings"])) <= {"device", "start_sha256", "small_below_px"}


def test_each_variant_has_its_own_corpora_and_both_test_sets() -> None:
    for variant, trainings in TRAININGS.items():
        own = datasets(variant)
        assert own.keys() == {name for training in trainings for name in training.corpora} | {"test", "empty"}
        assert all(training.settings(variant).is_file() for training in trainings)
        # No pair is in two corpora of one training.
        for training in trainings:
            pairs = [(own[name][0].recipe.name, index) for name in training.corpora for index in own[name][1]]
            assert len(pairs) == len(set(pairs))


def test_detectors_stand_side_by_side(tmp_path: Path) -> None:
    small = {"preset": "rgb-ideal", "encoding": "gamma", "width_px": 320, "height_px": 240, "focal_px": 533.3}
    for name, empty_fraction in (("test", 0.0), ("empty", 1.0)):
        frames = {"count": 3, "scenes": 3, "empty_fraction": empty_fraction}
        recipe = load_recipe("detector-small", frames=frames, rig=small, render={"engine": "analytic"})
        render_dataset(recipe, tmp_path / name, workers=0)
    (tmp_path / "test-photographs").mkdir()
    grey = np.full((480, 640, 3), 128, dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "test-photographs" / "grey.png"), grey)
    network = network_file("mobile-s")
    assert network is not None
    lines = list(score_lines(tmp_path, {"shipped": network, "new": network}))
    heads = ("drogue", "images", "drogues", "shipped: AP50, recall", "false boxes", "new: AP50, recall", "false boxes")
    assert lines[0] == f"| {' | '.join(heads)} |"
    assert lines[-5].startswith("| all | 6 |")
    # The same network scores the same.
    cells = lines[-5].strip("| ").split(" | ")[3:]
    assert cells[:2] == cells[2:]
    assert lines[-2].startswith("new: ") and lines[-2].endswith(" boxes in 6 images of frames without a drogue")
    assert lines[-1] == "new: boxes in 0 of 1 photographs without a drogue"
