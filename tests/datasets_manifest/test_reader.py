from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindDataset, BlindPair
from datasets_manifest.storage.layout import frame_folder
from datasets_manifest.storage.manifest import build_manifest, write_manifest
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset, read_shutter
from tests.support.changed_records import with_another_pose


@pytest.mark.parametrize("preset", ["rgb-ideal", "paper-colour", "mono"])
@pytest.mark.parametrize("bits", [8, 12])
def test_images_and_parts_come_back(
    maker: tuple[Callable[..., Any], ...], tmp_path: Path, preset: str, bits: int
) -> None:
    make_recipe, make_images, make_parts, _, add_frame = maker
    recipe = make_recipe(preset, bits)
    add_frame(tmp_path, recipe, 1)
    write_manifest(tmp_path, build_manifest(tmp_path, recipe, "1", dict.fromkeys(range(recipe.frames.scenes), "train")))
    dataset, wanted = Dataset(tmp_path), make_images(recipe, 1)
    for images in (dataset.images(1), BlindDataset(tmp_path).pair(1).images):
        for name in ("left", "right", "left_mosaic", "right_mosaic"):
            want, got = getattr(wanted, name), getattr(images, name)
            assert (want is None) == (got is None)
            if want is not None:
                assert got.dtype == want.dtype
                np.testing.assert_array_equal(got, want)
        for name in ("time_s", "exposure_s", "bits", "encoding", "black_level_dn"):
            assert getattr(images, name) == getattr(wanted, name)
    for eye, want in make_parts(recipe, 1).items():
        np.testing.assert_array_equal(dataset.part_ids(1, eye), want)


def test_indices_come_in_order(tiny: Path) -> None:
    assert Dataset(tiny).frame_indices == (0, 1, 3)
    assert BlindDataset(tiny).frame_indices == (0, 1, 3)


def test_verify_finds_what_changed(tiny: Path) -> None:
    dataset = Dataset(tiny)
    assert [dataset.verify(index) for index in dataset.frame_indices] == [[], [], []]
    folder = frame_folder(tiny, 1)
    (folder / "left.png").write_bytes((folder / "right.png").read_bytes())
    (folder / "right_parts.png").unlink()
    assert dataset.verify(1) == [
        f"{folder / 'left.png'}: was changed: its hash differs from the recorded one",
        f"{folder / 'right_parts.png'}: is missing",
    ]
    record = frame_folder(tiny, 0) / "record.json"
    record.write_bytes(record.read_bytes() + b" ")
    assert dataset.verify(0) == [f"{record}: was changed: its hash differs from the recorded one"]
    assert dataset.verify(2) == [f"{frame_folder(tiny, 2)}: is not in the manifest"]


def test_a_changed_record_is_no_truth(tiny: Path) -> None:
    dataset, file = Dataset(tiny), frame_folder(tiny, 1) / "record.json"
    file.write_bytes(with_another_pose(file.read_bytes()))
    for read in (dataset.unchanged_record, dataset.checked_record, lambda index: list(dataset.records())):
        with pytest.raises(ValueError, match=r"000001/record\.json: was changed"):
            read(1)
    faults = PairFaults()
    assert [record.frame_index for record in dataset.records(faults)] == [0, 3] and faults.count == 1
    with pytest.raises(ValueError, match="000002: is not in the manifest"):
        dataset.checked_record(2)


def test_a_record_is_parsed_once_until_it_changes(tiny: Path) -> None:
    dataset = Dataset(tiny)
    first = dataset.record(1)
    assert dataset.record(1) is first
    assert dataset.shutter(1) == read_shutter(dataset.frames, 1)
    assert dataset.record(3).frame.rig is first.frame.rig
    file = frame_folder(tiny, 1) / "record.json"
    text = file.read_text()
    file.write_text(text.replace(f'"time_s":{first.time_s}', f'"time_s":{first.time_s + 1}'))
    assert dataset.shutter(1).time_s == dataset.record(1).time_s == first.time_s + 1
    file.write_text(text.replace('"baseline_m":', '"baseline_m":1'))
    with pytest.raises(ValueError, match=r"frame\.rig: differs"):
        dataset.record(1)


def test_damaged_files_are_named(tiny: Path) -> None:
    dataset, blind, folder = Dataset(tiny), BlindDataset(tiny), frame_folder(tiny, 1)
    whole = (folder / "left.png").read_bytes()
    (folder / "left.png").write_bytes(whole[:-10])
    for read in (dataset.images, blind.pair):
        with pytest.raises(ValueError, match=r"000001/left\.png: the PNG is truncated"):
            read(1)
    (folder / "left.png").write_bytes((folder / "left_parts.png").read_bytes())
    with pytest.raises(ValueError, match=r"left\.png: must be \(36, 48, 3\) of uint8, got \(36, 48\)"):
        dataset.images(1)
    (folder / "left_parts.png").unlink()
    with pytest.raises(ValueError, match=r"left_parts\.png: is missing"):
        dataset.part_ids(1, "left")
    record = folder / "record.json"
    text = record.read_text()
    for damaged in (text[:100], "[]", "", "\0"):
        record.write_text(damaged)
        for read in (dataset.record, dataset.images, blind.pair):
            with pytest.raises(ValueError, match=r"000001/record\.json: ") as caught:
                read(1)
            assert "\n" not in str(caught.value)
    record.write_text(text.replace('"frame_index":1', '"frame_index":2'))
    with pytest.raises(ValueError, match="frame_index: must be 1, got 2"):
        dataset.record(1)
    record.write_text(text.replace('"scene_id":1', '"scene_id":-1'))
    with pytest.raises(ValueError, match="scene_id"):
        dataset.record(1)
    with pytest.raises(ValueError, match=r"000077/record\.json: is missing"):
        dataset.record(77)


def test_links_out_of_the_frame_are_refused(tiny: Path, tmp_path: Path) -> None:
    path = frame_folder(tiny, 1) / "left.png"
    elsewhere = tmp_path / "secret.png"
    path.rename(elsewhere)
    path.symlink_to(elsewhere)
    with pytest.raises(ValueError, match=r"left\.png: leads outside the frame's folder"):
        Dataset(tiny).images(1)
    assert "leads outside" in Dataset(tiny).verify(1)[0]


def test_blind_pairs_hold_no_truth(tiny: Path) -> None:
    """An empty frame looks like any other but for its pixels, and no attribute leads to a record."""
    blind = BlindDataset(tiny)
    assert set(vars(BlindPair(0, None, None, None))) == {"frame_index", "images", "rig", "drogue"}
    full, empty = blind.pair(0), blind.pair(3)
    assert full.drogue == empty.drogue and full.rig is empty.rig
    assert {name for name in vars(blind) if not name.startswith("_")} == {"frame_indices", "rig", "drogue"}
    methods = {name for name in dir(type(blind)) if not name.startswith("_")}
    assert methods == {"pair", "sought_drogue"}


def test_blind_reading_does_not_need_valid_truth(tiny: Path) -> None:
    """Labels may be cut out of a dataset before it is handed on; images stay readable."""
    path = frame_folder(tiny, 0) / "record.json"
    path.write_text('{"time_s": 0.5, "frame": {"exposure": {"time_s": 0.002}}, "image_black_level_dn": 1.0}')
    images = BlindDataset(tiny).pair(0).images
    assert (images.time_s, images.exposure_s, images.black_level_dn) == (0.5, 0.002, 1.0)
    path.write_text('{"time_s": 0.5}')
    with pytest.raises(ValueError, match="no valid time_s or exposure"):
        BlindDataset(tiny).pair(0)


def test_missing_dataset() -> None:
    for reader in (Dataset, BlindDataset):
        with pytest.raises(ValueError, match="there is no such dataset folder"):
            reader(Path("/nonexistent/dataset"))
