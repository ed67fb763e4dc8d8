from __future__ import annotations

import fcntl
import io
import json
import resource
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from droguekit.batch.progress import PlainProgress
from geometry.stereo import EYES
from nav.detector.input_image import input_image
from nav.training.corpus import Corpus, open_corpus
from tests.support.changed_records import with_another_pose
from tests.support.recipe_builder import RIG_160_PX
from tests.support.small_datasets import render_toy

SIZE_PX = (96, 128)


def open_small(paths: list[Path], cache: Path) -> Corpus:
    return open_corpus(paths, cache, SIZE_PX, 2, PlainProgress(io.StringIO()))


def first_frame(dataset: Path) -> Path:
    return min((dataset / "frames").iterdir())


def test_cached_images_are_the_detectors_input_and_boxes_are_those_of_coco(split_dataset: Path, tmp_path: Path) -> None:
    corpus, dataset = open_small([split_dataset], tmp_path), Dataset(split_dataset)
    coco = json.loads((split_dataset / "annotations" / "all.json").read_text())
    of_image = {entry["image_id"]: entry["bbox"] for entry in coco["annotations"]}
    for pair, frame_index in enumerate(dataset.frame_indices):
        for eye in (0, 1):
            expected, _ = input_image(dataset.images(frame_index), EYES[eye], SIZE_PX[::-1])
            np.testing.assert_array_equal(corpus.image(pair, eye), expected)
            bbox = of_image.get(2 * frame_index + eye + 1)
            assert len(corpus.boxes(pair, eye)) == (bbox is not None)
            if bbox is not None:
                # The image fits the input exactly: COCO's numbers are scaled by 128 / 320.
                np.testing.assert_allclose(corpus.boxes(pair, eye)[0], np.array(bbox) * 0.4, atol=1e-2)  # COCO's digits
    counts = dataset.manifest.counts.by_split
    assert {split: len(corpus.split(split)) for split in counts} == counts and min(counts.values()) > 0


def test_a_cache_is_used_again_and_a_damaged_one_is_made_again(split_dataset: Path, tmp_path: Path) -> None:
    first = open_small([split_dataset], tmp_path)
    (images,) = tmp_path.glob("*/images.npy")
    written_ns = images.stat().st_mtime_ns
    open_small([split_dataset], tmp_path)
    assert images.stat().st_mtime_ns == written_ns
    expected = np.array(first.caches[0].images)
    content = images.read_bytes()
    (tmp_path / ".left-by-a-killed-run.part").mkdir()
    for damaged in (content[: len(content) // 2], b"", b"\x93NUMPY"):
        images.write_bytes(damaged)
        np.testing.assert_array_equal(open_small([split_dataset], tmp_path).caches[0].images, expected)
    (opacities,) = tmp_path.glob("*/opacities.npy")
    longer = np.append(first.caches[0].opacities, np.zeros(5, np.uint8))
    for wrong in (longer, longer[:-5].astype(np.float32)):
        np.save(opacities, wrong)
        found = open_small([split_dataset], tmp_path).caches[0].opacities
        np.testing.assert_array_equal(found, first.caches[0].opacities)
        assert found.dtype == np.uint8
    assert not list(tmp_path.glob("*.part"))


def test_a_full_disk_leaves_no_cache(split_dataset: Path, tmp_path: Path) -> None:
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(OSError, match="cannot be written"):
            open_small([split_dataset], tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert [each.name for each in tmp_path.iterdir()] == [".lock"]


def test_waiting_for_another_cache_is_reported_once_and_can_be_stopped(split_dataset: Path, tmp_path: Path) -> None:
    told, asked = io.StringIO(), []

    def stops_at_the_third_time() -> bool:
        asked.append(True)
        return len(asked) == 3

    with (tmp_path / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(KeyboardInterrupt):
            open_corpus([split_dataset], tmp_path, SIZE_PX, 1, PlainProgress(told), stops_at_the_third_time)
    assert told.getvalue().count("waiting for another training") == 1
    open_small([split_dataset], tmp_path)


def damage_pixels(frame: Path) -> None:
    path = frame / "right.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


def change_pose(frame: Path) -> None:
    path = frame / "record.json"
    path.write_bytes(with_another_pose(path.read_bytes()))


@pytest.mark.parametrize(
    ("damage", "names"),
    [
        (damage_pixels, "right.png"),
        (lambda frame: (frame / "left.png").write_bytes(b""), "left.png"),
        (lambda frame: (frame / "left.png").unlink(), "left.png"),
        (lambda frame: (frame / "record.json").write_text("{"), "record.json"),
        (change_pose, "record.json"),
        (shutil.rmtree, ""),
    ],
    ids=["corrupt image", "empty image", "missing image", "truncated record", "changed record", "missing frame"],
)
def test_a_damaged_pair_is_left_out_and_named_before_training(
    split_dataset: Path, tmp_path: Path, damage: Callable[[Path], None], names: str
) -> None:
    dataset = tmp_path / "dataset"
    shutil.copytree(split_dataset, dataset)
    frame = first_frame(dataset)
    damage(frame)
    for _ in range(2):  # made, and read from the cache
        corpus = open_small([dataset], tmp_path / "cache")
        assert len(corpus.places) == len(list((split_dataset / "frames").iterdir())) - 1
        assert corpus.fault is not None and "\n" not in corpus.fault
        assert str(frame) in corpus.fault and names in corpus.fault
    shutil.rmtree(frame, ignore_errors=True)
    shutil.copytree(split_dataset / "frames" / frame.name, frame)
    corpus = open_small([dataset], tmp_path / "cache")
    assert corpus.fault is None
    assert replace(corpus, sources=()).fault is None
    whole = open_small([split_dataset], tmp_path / "whole")
    assert len(corpus.places) == len(whole.places)
    np.testing.assert_array_equal(corpus.image(0, 1), whole.image(0, 1))


def test_a_dataset_without_a_manifest_or_a_whole_pair_is_named(split_dataset: Path, tmp_path: Path) -> None:
    dataset = tmp_path / "dataset"
    shutil.copytree(split_dataset, dataset)
    for frame in (dataset / "frames").iterdir():
        (frame / "left.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"left\.png"):
        open_small([dataset], tmp_path / "cache")
    (dataset / "manifest.json").unlink()
    with pytest.raises(ValueError, match=r"manifest\.json"):
        open_small([dataset], tmp_path / "cache")


def test_datasets_without_anything_to_learn_from_are_refused(split_dataset: Path, tmp_path: Path) -> None:
    rig = RIG_160_PX | {"focal_px": 150.0, "encoding": None}
    two = {"count": 2, "scenes": 1, "empty_fraction": None}
    other = render_toy(tmp_path / "other", frames=two, rig=rig)
    with pytest.raises(ValueError, match=r"other: its images are 160 x 120 px, but those of .* 320 x 240 px"):
        open_small([split_dataset, other], tmp_path / "cache")
    empty = render_toy(tmp_path / "empty", frames={"count": 2, "scenes": 1, "empty_fraction": 1.0})
    with pytest.raises(ValueError, match="empty: has no pair with a drogue"):
        open_small([empty], tmp_path / "cache")
    untaught = render_toy(tmp_path / "untaught", frames=two, split={"train": 0.0, "val": 0.0, "test": 1.0})
    with pytest.raises(ValueError, match="untaught: has no pair in the split train"):
        open_small([untaught], tmp_path / "cache")
    with pytest.raises(ValueError, match="is the same dataset as"):
        open_small([split_dataset, split_dataset], tmp_path / "cache")
    with pytest.raises(ValueError, match="datasets: none given"):
        open_small([], tmp_path / "cache")


def test_a_dataset_without_any_drogue_teaches_beside_others(split_dataset: Path, tmp_path: Path) -> None:
    empty = render_toy(tmp_path / "empty", frames={"count": 2, "scenes": 1, "empty_fraction": 1.0})
    corpus = open_small([split_dataset, empty], tmp_path / "cache")
    assert len(corpus.places) == 10
    assert not any(len(corpus.boxes(pair, eye)) for pair in (8, 9) for eye in (0, 1))
    np.testing.assert_array_equal(corpus.image(0, 0), open_small([split_dataset], tmp_path / "cache").image(0, 0))


def test_several_datasets_form_one_sequence_of_pairs(split_dataset: Path, tmp_path: Path) -> None:
    # Another rig, whose images have the same size.
    rig, frames = {"focal_px": 220.0, "encoding": None}, {"count": 2, "scenes": 1, "empty_fraction": None}
    second = render_toy(tmp_path / "second", seed=6, frames=frames, rig=rig)
    corpus = open_small([split_dataset, second], tmp_path / "cache")
    assert [(stamp.name, stamp.train_pairs) for stamp in corpus.datasets] == [("toy", 4), ("toy", 2)]
    assert len(corpus.places) == 10
    alone = open_small([second], tmp_path / "cache")
    np.testing.assert_array_equal(corpus.image(9, 1), alone.image(1, 1))
    np.testing.assert_array_equal(corpus.boxes(9, 0), alone.boxes(1, 0))
