"""Scores of a training of shipped weights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from nav.detector.detector_registry import network_file
from scenes.sampler import scene_of_frame
from studies.detector_weights.__main__ import MORE_SCENES, frames_of_first_scenes, score_lines


def test_the_second_corpus_has_whole_scenes() -> None:
    recipe = load_recipe(str(Path(__file__).parents[3] / "studies" / "detector_weights" / "more-scenes.toml"))
    frames = frames_of_first_scenes(recipe, MORE_SCENES)
    scenes = [scene_of_frame(recipe, index) for index in frames]
    assert len(set(scenes)) == MORE_SCENES
    assert {scenes.count(scene) for scene in scenes} == {recipe.frames.count // recipe.frames.scenes}


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
