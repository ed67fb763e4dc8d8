"""Datasets from Python, against the files that OpenCV and OpenEXR read themselves."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

import droguekit
from datasets_manifest.storage.layout import image_file, parts_file, passes_file
from datasets_manifest.storage.reader import Dataset
from droguekit.api.stereo_dataset import StereoDataset
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export


def test_images_are_those_of_the_files(pairs: StereoDataset, pairs_folder: Path) -> None:
    assert len(pairs) == 8
    for pair in pairs:
        folder = pairs_folder / "frames" / f"{pair.frame_index:06d}"
        for eye, image in (("left", pair.left), ("right", pair.right)):
            bgr = cv2.imread(str(folder / image_file(eye)), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(image, bgr[:, :, ::-1])


def test_truth_masks_and_depths_are_those_of_the_files(pairs: StereoDataset, pairs_folder: Path) -> None:
    pair = next(each for each in pairs if each.truth is not None)
    assert pair.truth is not None
    folder = pairs_folder / "frames" / f"{pair.frame_index:06d}"
    record = json.loads((folder / "record.json").read_text())
    assert pair.truth.as_matrix().tolist() == record["left_from_drogue"]
    parts = cv2.imread(str(folder / parts_file("left")), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(pair.part_ids["left"], parts)
    assert int(pair.masks["left"].sum()) == record["views"]["left"]["visible_drogue_px"] > 0
    with OpenEXR.File(str(folder / passes_file("left")), separate_channels=True) as file:
        assert np.array_equal(pair.depth_m["left"], file.channels()["depth.Z"].pixels)
    drogue_m = pair.depth_m["left"][pair.masks["left"]]
    assert abs(float(np.median(drogue_m)) - pair.truth.translation_m[2]) < 0.3


def test_pairs_are_chosen_by_position_slice_and_frame(pairs: StereoDataset) -> None:
    assert pairs[-1].frame_index == 7
    assert [pair.frame_index for pair in pairs[2:8:3]] == [2, 5]
    assert pairs[2:8:3].frame(5).frame_index == 5
    with pytest.raises(ValueError, match="has no pair 3"):
        pairs[2:8:3].frame(3)
    with pytest.raises(IndexError):
        pairs[8]
    with pytest.raises(ValueError, match="has no pair 99"):
        StereoDataset(pairs.path, [99])


def test_selections_are_those_of_the_records(pairs: StereoDataset, pairs_folder: Path) -> None:
    reader = Dataset(pairs_folder)
    distances_m = {index: reader.record(index).conditions.distance_m for index in reader.frame_indices}
    shown = [index for index, distance_m in distances_m.items() if distance_m is not None]
    assert 0 < len(shown) < 8
    middle_m = float(np.median([distance_m for distance_m in distances_m.values() if distance_m is not None]))
    near = pairs.select(distance_m=(0.0, middle_m))
    assert near.frame_indices == tuple(index for index in shown if (distances_m[index] or 0.0) <= middle_m)
    assert pairs.select(with_drogue=False).frame_indices == tuple(sorted(set(distances_m) - set(shown)))
    split = reader.manifest.split_of_frame()
    for name in ("train", "val", "test"):
        expected = tuple(index for index in range(8) if split[index] == name)
        assert pairs.select(split=name).frame_indices == expected
    assert len(set(split.values())) > 1


def test_indices_may_be_any_whole_numbers_in_any_collection(pairs: StereoDataset) -> None:
    assert StereoDataset(pairs.path, (index for index in (3, 1))).frame_indices == (3, 1)
    assert StereoDataset(pairs.path, np.array([3, 1])).frame_indices == (3, 1)
    assert pairs.frame(np.int64(3)).frame_index == 3
    with pytest.raises(TypeError, match="integer"):
        StereoDataset(pairs.path, [1.0])  # type: ignore[list-item]
    with pytest.raises(TypeError, match="integer"):
        pairs.frame(1.0)  # type: ignore[arg-type]


def test_a_dataset_knows_its_pairs(pairs: StereoDataset, pairs_folder: Path, tmp_path: Path) -> None:
    write_export("blind", pairs_folder, tmp_path / "blind", ExportLog())
    blind = droguekit.open_dataset(tmp_path / "blind")
    for dataset, other in ((pairs, blind), (blind, pairs)):
        assert dataset[3] in dataset and dataset[3] in dataset[2:] and dataset[3] not in dataset[:3]
        assert dataset[1:].index(dataset[3]) == 2
        assert other[3] not in dataset and "a word" not in dataset
        assert len({dataset[3], dataset[3], dataset[4]}) == 2


def test_a_slice_keeps_its_order(pairs: StereoDataset) -> None:
    assert pairs[::-1].frame_indices == pairs.frame_indices[::-1]


def test_wrong_selections_are_refused(pairs: StereoDataset) -> None:
    with pytest.raises(ValueError, match="family: must be one of"):
        pairs.select(family="storm")
    with pytest.raises(ValueError, match="split: must be train, val or test, got 'dev'"):
        pairs.select(split="dev")  # type: ignore[arg-type]
    for wrong in ((5.0, 2.0), (float("nan"), 2.0), (2.0, float("nan"))):
        with pytest.raises(ValueError, match=r"distance_m: must be the least and the largest distance, got \("):
            pairs.select(distance_m=wrong)


def test_a_blind_dataset_has_images_but_no_truth(pairs: StereoDataset, pairs_folder: Path, tmp_path: Path) -> None:
    write_export("blind", pairs_folder, tmp_path / "blind", ExportLog())
    blind = droguekit.open_dataset(tmp_path / "blind")
    assert not blind.has_truth
    assert len(blind) == 8
    assert np.array_equal(blind[3].left, pairs[3].left)
    assert blind[3].drogue == pairs[3].drogue
    for read in (
        lambda: blind[3].record,
        lambda: blind[3].masks,
        lambda: blind[3].depth_m,
        lambda: blind.select(with_drogue=True),
    ):
        with pytest.raises(ValueError, match="is a blind dataset"):
            read()


def test_depths_that_were_not_stored_are_explained(smoke_dataset: Path) -> None:
    with pytest.raises(ValueError, match=r"is missing; render with `\[outputs\] exr = true`"):
        _ = droguekit.open_dataset(smoke_dataset)[0].depth_m


def test_an_empty_path_is_not_the_current_folder(pairs_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(pairs_folder)
    assert len(droguekit.open_dataset(".")) == 8
    with pytest.raises(ValueError, match="must be a folder or a URL, got ''"):
        droguekit.open_dataset("")


def test_a_missing_dataset_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no such dataset folder"):
        droguekit.open_dataset(tmp_path / "nothing")


def test_a_dataset_survives_pickling(pairs: StereoDataset) -> None:
    again = pickle.loads(pickle.dumps(pairs[1:3]))
    assert again.frame_indices == (1, 2)
    assert np.array_equal(again[0].left, pairs[1].left)
