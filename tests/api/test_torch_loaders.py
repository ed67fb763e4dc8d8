"""PyTorch datasets: samples against the pairs they come from, and the order in which pairs are rendered and shown."""

from __future__ import annotations

import io
import itertools
import multiprocessing
import shutil
from collections import Counter
from multiprocessing.context import BaseContext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import droguekit
from datasets_manifest.recipe.recipe import Recipe, RecipeSource
from datasets_manifest.storage.layout import MANIFEST_FILE, RECORD_FILE, frame_folder
from datasets_manifest.storage.manifest import read_manifest, with_build, write_manifest
from droguekit.api.recipe_rendering import RECIPE_TEXT
from droguekit.api.stereo_dataset import StereoDataset
from droguekit.batch.merge_shards import merge_shards
from droguekit.batch.progress import PlainProgress
from droguekit.batch.resume import open_dataset
from droguekit.torch import PairDataset, RenderStream, sample_of_pair
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.changed_records import with_another_pose
from tests.support.recipe_builder import build_recipe
from tests.support.small_datasets import SINGLE_PAIRS


@pytest.fixture(scope="module")
def forks() -> BaseContext:
    """How loaders start processes: from one that has imported already what they need."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["droguekit.torch", "droguekit.batch.frame_task"])
    return context


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """Twelve pairs that render quickly."""
    return build_recipe(SINGLE_PAIRS, seed=8, frames={"count": 12, "scenes": 3})


def test_samples_are_the_pairs(pairs: StereoDataset) -> None:
    dataset = PairDataset(pairs)
    assert len(dataset) == len(pairs)
    for sample, pair in zip((dataset[index] for index in range(len(dataset))), pairs, strict=True):
        assert np.array_equal(sample["left"].numpy(), np.moveaxis(pair.left, 2, 0))
        assert np.array_equal(sample["right"].numpy(), np.moveaxis(pair.right, 2, 0))
        assert sample["frame_index"].item() == pair.frame_index
        pose = sample["left_from_drogue"].numpy()
        if pair.truth is None:
            assert np.isnan(pose).all()
            assert np.isnan(sample["boxes_px"].numpy()).all()
            continue
        assert np.array_equal(pose, pair.truth.as_matrix())
        x, y, width, height = pair.record.views.right.box_full_xywh_px or (0.0,) * 4
        assert np.allclose(sample["boxes_px"][1].numpy(), (x + 0.5, y + 0.5, width, height))
        first = pair.record.views.left.markers[0]
        expected = (*(np.array(first.center_proj_px) + 0.5), first.visible_fraction)
        assert np.allclose(sample["keypoints_px"][0, 0].numpy(), expected)


def test_changed_pairs_are_left_out(pairs: StereoDataset, tmp_path: Path) -> None:
    copy = shutil.copytree(Path(pairs.path), tmp_path / "copy")
    shown = next(pair.frame_index for pair in pairs if pair.truth is not None)
    record = frame_folder(copy, shown) / RECORD_FILE
    record.write_bytes(with_another_pose(record.read_bytes()))
    dataset = PairDataset(copy, leave_out_damaged=True)
    assert dataset.faults.count == 1 and dataset.faults.first is not None
    assert dataset.faults.first == (shown, f"{record}: was changed: its hash differs from the recorded one")
    assert shown not in dataset.dataset.frame_indices and len(dataset) == len(pairs) - 1


def test_keypoints_lie_on_markers(pairs: StereoDataset) -> None:
    """Pixels, not records, tell where markers are: the part under a visible keypoint is that marker."""
    checked = 0
    for pair in pairs:
        points = sample_of_pair(pair)["keypoints_px"].numpy()
        for eye, of_eye in zip(("left", "right"), points, strict=True):
            for index, (x, y, visible) in enumerate(of_eye):
                if visible < 1:
                    continue
                assert pair.part_ids[eye][int(y), int(x)] == 32 + index
                checked += 1
    assert checked > 20


def test_drogues_of_unlike_numbers_of_markers_stack_in_one_batch(tmp_path: Path) -> None:
    variants = [{"drogue": name} for name in ("red-8", "red-5", "white-5")]
    mixed = build_recipe(
        SINGLE_PAIRS, frames={"count": 12, "scenes": 12, "empty_fraction": 0.2}, target={"variants": variants}
    )
    droguekit.render_dataset(mixed, tmp_path / "mixed", workers=0)
    stored = PairDataset(tmp_path / "mixed")
    counts = {pair.drogue.marker_count for pair in stored.dataset if pair.truth is not None}
    assert counts == {5, 8}
    for dataset in (stored, RenderStream(mixed, tmp_path / "stream")):
        (batch,) = DataLoader(dataset, batch_size=12)
        assert batch["keypoints_px"].shape == (12, 2, 8, 3)
        for points, pair in zip(batch["keypoints_px"], stored.dataset, strict=True):
            own = sample_of_pair(pair)["keypoints_px"]
            np.testing.assert_array_equal(points[:, : own.shape[1]], own)
            assert points[:, own.shape[1] :, :2].isnan().all() and not points[:, own.shape[1] :, 2].any()


@pytest.mark.parametrize("cache", ["s3://bucket/name", ""])
def test_a_stream_needs_a_folder_of_this_machine(cache: str, recipe: Recipe) -> None:
    with pytest.raises(ValueError, match=rf"cache: must be a folder of this machine, got '{cache}'"):
        RenderStream(recipe, cache)


def test_a_slice_of_samples_is_refused(pairs: StereoDataset) -> None:
    with pytest.raises(TypeError, match=r"^index: must be one position; slice the pairs before"):
        PairDataset(pairs)[0:2]
    assert PairDataset(pairs[0:2])[-1]["frame_index"].item() == 1


def test_a_loader_with_processes_gives_every_pair_once(pairs: StereoDataset) -> None:
    loader: DataLoader[Any] = DataLoader(
        PairDataset(pairs), batch_size=4, num_workers=2, multiprocessing_context="spawn"
    )
    indices = [index for batch in loader for index in batch["frame_index"].tolist()]
    assert indices == list(pairs.frame_indices)


def test_twelve_bits_and_grey_have_their_types() -> None:
    recipe = build_recipe(
        SINGLE_PAIRS, rig={"preset": "mono", "width_px": 160, "height_px": 120, "focal_px": 266.0, "output_bits": 12}
    )
    sample = sample_of_pair(droguekit.render_pair(recipe, 0))
    assert sample["left"].shape == (1, 120, 160)
    assert sample["left"].dtype == torch.int16
    assert 255 < int(sample["left"].max()) < 4096


def shown(stream: RenderStream) -> list[int]:
    """Frames in the order in which a stream gives them."""
    return [sample["frame_index"].item() for sample in stream]


def test_a_stream_renders_the_pairs_of_the_recipe(recipe: Recipe, tmp_path: Path) -> None:
    stream = RenderStream(recipe, tmp_path / "cache")
    for sample in stream:
        pair = droguekit.render_pair(recipe, sample["frame_index"].item())
        assert np.array_equal(sample["left"].numpy(), np.moveaxis(pair.left, 2, 0))
    assert sorted(path.name for path in (tmp_path / "cache" / "frames").iterdir()) == [f"{k:06d}" for k in range(12)]


def test_earlier_frames_come_again_in_between(recipe: Recipe, tmp_path: Path) -> None:
    order = list(RenderStream(recipe, tmp_path / "cache", replays=3).frame_order(0, 1))
    assert order[::4] == list(range(12))
    assert len(order) == 48
    for position, frame in enumerate(order):
        assert frame <= position // 4
    assert len(set(order[1::4])) > 3


def test_epochs_differ_and_repeat(recipe: Recipe, tmp_path: Path) -> None:
    stream = RenderStream(recipe, tmp_path / "cache", replays=3)
    first = list(stream.frame_order(0, 1))
    stream.start_at(epoch=1)
    assert list(stream.frame_order(0, 1)) != first
    stream.start_at(epoch=0)
    assert list(stream.frame_order(0, 1)) == first


@pytest.mark.parametrize("shards", [1, 2, 5])
def test_processes_share_the_frames(shards: int, recipe: Recipe, tmp_path: Path) -> None:
    stream = RenderStream(recipe, tmp_path / "cache", replays=2)
    orders = [list(stream.frame_order(shard, shards)) for shard in range(shards)]
    new = Counter(frame for order in orders for frame in order[::3])
    assert new == Counter(range(12))
    for shard, order in enumerate(orders):
        assert {frame % shards for frame in order} == {shard}


def test_ranks_and_processes_of_loaders_render_each_frame_once(
    recipe: Recipe, forks: BaseContext, tmp_path: Path
) -> None:
    frames: list[int] = []
    streams = [RenderStream(recipe, tmp_path / "cache", rank=rank, ranks=2) for rank in range(2)]
    for stream in streams:
        loader: DataLoader[Any] = DataLoader(stream, batch_size=2, num_workers=2, multiprocessing_context=forks)
        frames += [index for batch in loader for index in batch["frame_index"].tolist()]
    assert sorted(frames) == list(range(12))
    # Their caches are parts of the dataset that one run makes.
    assert all(validate_dataset(stream.cache).passed for stream in streams)
    merged = merge_shards(tmp_path / "merged", [stream.cache for stream in streams], PlainProgress(io.StringIO()))
    whole = droguekit.render_dataset(recipe, tmp_path / "whole", workers=0)
    assert merged.dataset_sha256 == whole.reader.manifest.dataset_sha256


def test_a_cache_is_described_once_all_its_frames_are_there(recipe: Recipe, tmp_path: Path) -> None:
    stream = RenderStream(recipe, tmp_path / "cache")
    described = []
    for _ in stream:
        described.append(len(read_manifest(stream.cache).frames))
    assert described == [0] * 12 and len(read_manifest(stream.cache).frames) == 12
    written_ns = (stream.cache / MANIFEST_FILE).stat().st_mtime_ns
    assert len(shown(stream)) == 12 and (stream.cache / MANIFEST_FILE).stat().st_mtime_ns == written_ns


def test_a_stream_that_another_build_began_names_both(recipe: Recipe, tmp_path: Path) -> None:
    stream, whole = RenderStream(recipe, tmp_path / "cache"), tmp_path / "whole"
    for _ in itertools.islice(stream, 6):
        pass
    manifest = read_manifest(stream.cache)
    numpy = manifest.software["numpy"]
    write_manifest(stream.cache, with_build(manifest, {**manifest.software, "numpy": "9.9"}, manifest.cpu_features))
    shutil.copytree(stream.cache, whole)
    shown(stream)
    droguekit.render_dataset(recipe, whole, workers=0)
    described = read_manifest(stream.cache)
    assert set(described.software["numpy"].split(" and ")) == {numpy, "9.9"} and len(described.frames) == 12
    assert described.software == read_manifest(whole).software


def test_ranks_that_start_at_the_same_time_do_not_lock_each_other_out(recipe: Recipe, tmp_path: Path) -> None:
    first = RenderStream(recipe, tmp_path / "cache", rank=0, ranks=2)
    # Opening a cache locks it, and removes what killed runs have left there.
    with open_dataset(first.cache, RecipeSource(recipe, RECIPE_TEXT)):
        second = RenderStream(recipe, tmp_path / "cache", rank=1, ranks=2)
        assert next(iter(second))["frame_index"].item() == 1


@pytest.mark.parametrize("workers", [0, 2])
def test_an_interrupted_training_goes_on_with_the_same_batches(
    workers: int, recipe: Recipe, forks: BaseContext, tmp_path: Path
) -> None:
    context = forks if workers else None

    def batches(done: int, most: int | None = None) -> list[list[int]]:
        stream = RenderStream(recipe, tmp_path / "cache", replays=1)
        stream.start_at(epoch=2, batches_done=done, batch_size=3)
        loader: DataLoader[Any] = DataLoader(stream, batch_size=3, num_workers=workers, multiprocessing_context=context)
        return [batch["frame_index"].tolist() for batch in itertools.islice(loader, most)]

    whole = batches(0)
    assert len(whole) == 8
    # Two stops, at numbers that two processes do not divide.
    assert batches(3, 2) == whole[3:5]
    assert batches(5) == whole[5:]


@pytest.mark.parametrize(("workers", "batch_size"), [(3, 2), (5, 3)])
def test_a_training_goes_on_at_every_batch_with_the_next_one(
    workers: int, batch_size: int, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of twelve frames, two of five processes have three and the others two: they end earlier."""
    stream = RenderStream(recipe, tmp_path / "cache", replays=3)
    monkeypatch.setattr("droguekit.torch.FrameTask", lambda *_, **__: lambda index: None)
    monkeypatch.setattr("droguekit.torch.stored_pair", lambda _, index: index)
    monkeypatch.setattr("droguekit.torch.sample_of_pair", lambda index, **_: index)

    def batches(done: int) -> list[list[int]]:
        """As torch's data loader takes them: from its processes in turn, but those at their end."""
        stream.start_at(epoch=0, batches_done=done, batch_size=batch_size)
        of_process = []
        for worker in range(workers):
            info = SimpleNamespace(id=worker, num_workers=workers)
            monkeypatch.setattr("droguekit.torch.get_worker_info", lambda info=info: info)
            frames = list(stream)
            of_process.append([frames[place : place + batch_size] for place in range(0, len(frames), batch_size)])
        turns = itertools.zip_longest(*of_process)
        return [batch for turn in turns for batch in turn if batch is not None]

    whole = batches(0)
    assert sum(map(len, whole)) == 48
    for done in range(len(whole) + 1):
        assert batches(done) == whole[done:]


def test_a_cache_is_a_dataset_that_rendering_completes(recipe: Recipe, tmp_path: Path) -> None:
    stream = RenderStream(recipe, tmp_path / "cache")
    first = [frame for frame, _ in zip(shown(stream), range(3), strict=False)]
    assert first == [0, 1, 2]
    other = build_recipe(SINGLE_PAIRS, seed=9, frames={"count": 12, "scenes": 3})
    with pytest.raises(ValueError, match="was made from another recipe: they differ in seed"):
        RenderStream(other, tmp_path / "cache")


def test_wrong_numbers_are_refused(recipe: Recipe, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="replays: must not be negative"):
        RenderStream(recipe, tmp_path / "cache", replays=-1)
    with pytest.raises(ValueError, match="rank: must be from 0 to ranks - 1 = 1, got 2"):
        RenderStream(recipe, tmp_path / "cache", rank=2, ranks=2)
    with pytest.raises(ValueError, match="must be at least 0, 0 and 1, got 0, -1, 1"):
        RenderStream(recipe, tmp_path / "cache").start_at(0, -1)


def test_a_device_that_the_engine_cannot_use_is_refused_before_a_loader_starts(recipe: Recipe, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^device cuda: engine analytic renders on the processor only"):
        RenderStream(recipe, tmp_path / "cache", device="cuda")
    assert not (tmp_path / "cache").exists()
