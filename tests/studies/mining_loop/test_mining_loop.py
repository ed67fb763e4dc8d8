"""Cells of the mining loop's test set, on boxes whose answer is known."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from droguekit.scoring.detection.detection_truth import read_detection_truth
from droguekit.scoring.results.detection_result import image_id_of
from studies.mining_loop.__main__ import RECIPE, cell_scores, table


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("loop") / "pairs"
    small = {"preset": "rgb-ideal", "encoding": "gamma", "width_px": 160, "height_px": 120, "focal_px": 266.7}
    recipe = load_recipe(str(RECIPE), frames={"count": 8, "scenes": 8}, rig=small)
    render_dataset(recipe, folder, workers=0)
    return folder


def write_boxes(dataset: Path, out: Path, missed: str) -> Path:
    """Every box as in the truth, but none in a family."""
    rows = []
    for image in read_detection_truth(dataset).images:
        if image.box_xywh is not None and image.family != missed:
            row = {"image_id": image_id_of(image.frame_index, image.eye), "category_id": 1, "score": 0.9}
            rows.append(row | {"bbox": [float(value) for value in image.box_xywh]})
    out.write_text(json.dumps(rows))
    return out


def test_each_cell_scores_its_own_images(dataset: Path, tmp_path: Path) -> None:
    found = cell_scores(dataset, write_boxes(dataset, tmp_path / "all.json", ""))
    assert found and set(found.values()) == {100.0}
    missed = cell_scores(dataset, write_boxes(dataset, tmp_path / "some.json", "day"))
    assert missed.keys() == found.keys()
    assert {cell for cell, score in missed.items() if score == 0.0} == {
        cell for cell in found if cell.startswith("day")
    }


def test_the_gain_is_told_in_the_worst_cell_of_the_even_arm() -> None:
    even = [{"day": 90.0, "dusk": 40.0}, {"day": 90.0, "dusk": 50.0}, {"day": 90.0, "dusk": 60.0}]
    mined = [{"day": 80.0, "dusk": 52.0}, {"day": 80.0, "dusk": 60.0}, {"day": 80.0, "dusk": 68.0}]
    lines = table({"even": even, "mined": mined}, {"even": [70.0] * 3, "mined": [71.0] * 3})
    assert lines[2].startswith("| dusk |") and lines[2].endswith("| +10.0 |")
    # Differences of 12, 10 and 8: a standard deviation of 2, times 4.303 / sqrt(3).
    assert lines[-2] == "gain in the worst cell, dusk: +10.0, 95 % interval +5.0 to +15.0"
