"""Cells of the mining loop's test set, on boxes whose answer is known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from droguekit.scoring.detection.detection_truth import read_detection_truth
from droguekit.scoring.results.detection_result import image_id_of
from studies.mining_loop import __main__ as mining_loop
from studies.mining_loop.__main__ import RECIPE, cell_scores, main, table


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


def test_the_gain_of_any_number_of_seeds_has_its_interval() -> None:
    arms = {arm: [{"day": base + place % 2} for place in range(7)] for arm, base in (("even", 50.0), ("mined", 60.0))}
    arms["mined"][0]["day"] += 7.0
    lines = table(arms, {"even": [70.0] * 7, "mined": [71.0] * 7})
    # Differences of 17 and six times 10: mean 11, standard deviation sqrt(7), times Student's 2.447 / sqrt(7).
    assert lines[-2] == "gain in the worst cell, day: +11.0, 95 % interval +8.6 to +13.4"
    one = {arm: rows[:1] for arm, rows in arms.items()}
    assert table(one, {"even": [70.0], "mined": [71.0]})[-2] == "gain in the worst cell, day: +17.0"


@pytest.fixture
def trainings_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """A loop whose commands leave empty files; a call returns the trainings that it made."""
    made: list[str] = []

    def run(*words: object, log: Path) -> None:
        out = Path(str(words[words.index("--out") + 1]))
        if words[0] == "train":
            made.append(out.name)
            (out / "best.pt").write_text(out.name)
        if out.suffix:
            out.write_text("scenes = 1\n" if words[0] == "mine" else "[]")

    monkeypatch.setattr(mining_loop, "run_droguekit", run)
    monkeypatch.setattr(mining_loop, "make_corpora", lambda *arguments: None)
    monkeypatch.setattr(
        mining_loop, "Dataset", lambda folder: SimpleNamespace(manifest=SimpleNamespace(dataset_sha256=folder.name))
    )
    monkeypatch.setattr(mining_loop, "read_detection_truth", lambda dataset: SimpleNamespace(images=()))
    monkeypatch.setattr(mining_loop, "cell_scores", lambda dataset, boxes: {"day": 1.0})

    def loop(**changes: object) -> list[str]:
        made.clear()
        options = {"image_passes": 1000, "seeds": 1, "further_passes": None, "start_from": None, "kept": 0.3}
        main(out=tmp_path, test_pairs=2, workers=1, **{**options, **changes})  # type: ignore[arg-type]
        return list(made)

    return loop


def test_trainings_are_used_again_only_for_their_own_options(
    trainings_of: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert trainings_of() == ["first-0", "even-1", "mined-30-1"]
    assert trainings_of() == []
    assert trainings_of(kept=0.7) == ["mined-70-1"]
    assert trainings_of(further_passes=480) == ["even-further-1", "mined-30-further-1"]
    for changes in ({"image_passes": 2000}, {"further_passes": 960}):
        with pytest.raises(SystemExit):
            trainings_of(**changes)
        assert "holds a training with other passes; give another --out" in capsys.readouterr().err
    assert trainings_of(start_from="mobile-s") == ["even-from-mobile-s-1", "mined-30-mobile-s-from-mobile-s-1"]
    assert trainings_of(start_from="mobile-s", kept=0.7) == ["mined-70-mobile-s-from-mobile-s-1"]


@pytest.mark.parametrize(("content", "told"), [(None, "without made-from.json"), ("{", "made-from.json: is damaged")])
def test_a_folder_that_does_not_say_what_made_it_is_named(
    content: str | None,
    told: str,
    trainings_of: Callable[..., list[str]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    trainings_of()
    file = tmp_path / "trainings" / "first-0" / "made-from.json"
    file.unlink() if content is None else file.write_text(content)
    with pytest.raises(SystemExit):
        trainings_of()
    assert told in capsys.readouterr().err


def test_two_ways_to_train_on_are_refused(
    trainings_of: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        trainings_of(start_from="mobile-s", further_passes=480)
    assert "--start-from, --further-passes: give one of them" in capsys.readouterr().err
