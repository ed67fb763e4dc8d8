"""A dataset with several drogues, from the recipe to annotations, validation and what navigation is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from pycocotools.coco import COCO

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.reader import Dataset
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.recipe_builder import RIG_320_PX, recipe_text, stations
from tests.support.small_datasets import rendered

TABLE = recipe_text(
    name="variants",
    seed=2,
    rig=RIG_320_PX,
    frames={"count": 10, "scenes": 10, "empty_fraction": 0.2},
    distance=stations(2.0, 4.0),
    target={"missing_marker_fraction": 0.2, "variants": [{"drogue": "red-8"}, {"drogue": "white-5"}]},
    render={"engine": "analytic"},
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(TABLE, tmp_path_factory.mktemp("variants") / "set")


def test_it_is_valid(dataset: Path) -> None:
    assert validate_dataset(dataset).faults == []


def test_navigation_is_told_which_drogue_and_not_whether_it_is_there(dataset: Path) -> None:
    truth, blind = Dataset(dataset), BlindDataset(dataset)
    names = set()
    for index in truth.frame_indices:
        frame, told = truth.record(index).frame, blind.pair(index).drogue
        assert told == (frame.drogue or frame.sought)
        names.add(told.name)
    assert names == {"red-8", "white-5"}
    assert any(truth.record(index).frame.drogue is None for index in truth.frame_indices)


def test_other_software_reads_keypoints_of_all(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    coco = COCO(str(dataset / "annotations" / "all.json"))
    capsys.readouterr()
    (category,) = coco.loadCats(coco.getCatIds())
    assert len(category["keypoints"]) == 8
    shown = set()
    for annotation in coco.loadAnns(coco.getAnnIds()):
        assert len(annotation["keypoints"]) == 24
        shown.add(sum(flag > 0 for flag in annotation["keypoints"][2::3]))
    assert shown == {5, 8}


def test_missing_markers_are_labelled_as_hidden(dataset: Path) -> None:
    truth = Dataset(dataset)
    for index in truth.frame_indices:
        record = truth.record(index)
        if record.frame.condition is None:
            continue
        for state, marker in zip(record.frame.condition.markers, record.views.left.markers, strict=True):
            assert (marker.visible_fraction == 0) == state.missing
