"""Stereo pairs as PyTorch datasets: from disk, or rendered while a training runs.

This module needs the extra `train`. A sample is a dictionary of tensors that torch's own collation stacks:

| key | type | content |
|---|---|---|
| `left`, `right` | (3, H, W) or (1, H, W) uint8, or int16 for 12 bits | images, red, green, blue |
| `frame_index` | int64 | index of the pair |
| `time_s` | float64 | mid-exposure [s] |
| `left_from_drogue` | (4, 4) float64 | the true pose [m], NaN without a drogue |
| `boxes_px` | (2, 4) float32 | x, y of the low corner, width, height of the whole drogue by eye; NaN without |
| `keypoints_px` | (2, M, 3) float32 | x, y of each marker's centre, and its visible share, by eye; NaN and 0 without |

Pixels count from the corner of the image, as in COCO. In the datasets below M is that of the recipe's drogue with the
most markers.

The last three are missing where a dataset has no truth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset as MapDataset
from torch.utils.data import IterableDataset, get_worker_info

from datasets_manifest.atomic import try_lock
from datasets_manifest.random_streams import sample_generator
from datasets_manifest.recipe.recipe import Recipe, RecipeSource
from datasets_manifest.storage.frame_store import FrameStore, list_frames
from datasets_manifest.storage.layout import EVENTS_FILE, RECORD_FILE, frame_name
from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.pair_faults import PairFaults, read_or_note
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import Pixels, StereoImages
from datasets_manifest.types.records import ViewRecord
from drogue_models.marker_layout import marker_layout
from droguekit.api.recipe_rendering import RECIPE_TEXT
from droguekit.api.stereo_dataset import StereoDataset, StereoPair, stored_pair
from droguekit.batch.frame_task import FrameTask
from droguekit.batch.progress import progress_report
from droguekit.batch.render_dataset import describe_dataset
from droguekit.batch.resume import join_build, open_dataset
from render.device import Device
from render.engine import engine_notice

Sample = dict[str, torch.Tensor]
Transform = Callable[[Sample], Any]

# Pixel centres have whole coordinates; the corner of the image is at (-0.5, -0.5).
_CORNER_PX = 0.5


def sample_of_pair(pair: StereoPair, with_truth: bool = True, keypoints: int | None = None) -> Sample:
    """The tensors of a pair, as the head of this module lists them.

    Args:
        pair: of a dataset, or rendered.
        with_truth: whether to read the truth.
        keypoints: M, at least the number of the drogue's markers, which it is by default.

    Raises:
        ValueError: a file is missing or damaged, or fewer keypoints than markers; names it.
    """
    sample = {
        "left": _image_tensor(pair.left),
        "right": _image_tensor(pair.right),
        "frame_index": torch.tensor(pair.frame_index, dtype=torch.int64),
        "time_s": torch.tensor(pair.images.time_s, dtype=torch.float64),
    }
    if with_truth:
        pose = np.full((4, 4), np.nan) if pair.truth is None else pair.truth.as_matrix()
        views = (pair.record.views.left, pair.record.views.right)
        markers = marker_layout(pair.drogue).count
        count = markers if keypoints is None else keypoints
        if count < markers:
            raise ValueError(f"keypoints: {pair.drogue.name} has {markers} markers, got {count}")
        sample["left_from_drogue"] = torch.from_numpy(pose)
        sample["boxes_px"] = torch.from_numpy(np.stack([_box_px(view) for view in views]))
        sample["keypoints_px"] = torch.from_numpy(np.stack([_keypoints_px(view, count) for view in views]))
    return sample


def _image_tensor(image: Pixels) -> torch.Tensor:
    planes = image[None] if image.ndim == 2 else np.moveaxis(image, 2, 0)
    # torch can do little with uint16; 12 bits fit into int16.
    return torch.from_numpy(np.array(planes, dtype=np.uint8 if image.dtype == np.uint8 else np.int16))


def _box_px(view: ViewRecord) -> np.ndarray[Any, np.dtype[np.float32]]:
    if view.box_full_xywh_px is None:
        return np.full(4, np.nan, np.float32)
    x, y, width, height = view.box_full_xywh_px
    return np.array([x + _CORNER_PX, y + _CORNER_PX, width, height], np.float32)


def _keypoints_px(view: ViewRecord, count: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    points = np.full((count, 3), np.nan, np.float32)
    points[:, 2] = 0.0
    for row, marker in zip(points, view.markers, strict=False):
        x, y = marker.center_proj_px
        row[:] = x + _CORNER_PX, y + _CORNER_PX, marker.visible_fraction
    return points


def _most_markers(recipe: Recipe) -> int:
    return max(drogue.marker_count for drogue in recipe.drogues)


class PairDataset(MapDataset[Any]):
    """A dataset on disk, for `torch.utils.data.DataLoader`.

    Attributes:
        dataset: the pairs.
        faults: count the pairs that were left out.
    """

    def __init__(
        self,
        dataset: StereoDataset | str | Path,
        transform: Transform | None = None,
        *,
        leave_out_damaged: bool = False,
    ) -> None:
        """Open the dataset.

        Args:
            dataset: a path, a URL, or a selection of pairs.
            transform: changes each sample.
            leave_out_damaged: read every file once now, and leave out pairs of which one is missing or damaged. Without
                it, such a pair is an error at its turn.

        Raises:
            ValueError: no such dataset, or it cannot be trusted.
        """
        self.dataset = dataset if isinstance(dataset, StereoDataset) else StereoDataset(dataset)
        self.faults = PairFaults()
        if leave_out_damaged:
            read = self.dataset.reader.checked_record if self.dataset.has_truth else self._read_blind
            whole = [i for i in self.dataset.frame_indices if read_or_note(i, read, self.faults) is not None]
            self.dataset = StereoDataset(self.dataset.path, whole)
        self._transform = transform
        self._keypoints = _most_markers(self.dataset.reader.manifest.recipe) if self.dataset.has_truth else None

    def _read_blind(self, frame_index: int) -> StereoImages:
        return self.dataset.frame(frame_index).images

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.dataset)

    def __getitem__(self, index: int) -> Any:
        """The sample at a position.

        Raises:
            IndexError: no such position.
            ValueError: a file is missing or damaged; names it.
            TypeError: a slice.
        """
        if isinstance(index, slice):
            raise TypeError("index: must be one position; slice the pairs before, as in PairDataset(pairs[0:2])")
        sample = sample_of_pair(self.dataset[index], self.dataset.has_truth, self._keypoints)
        return sample if self._transform is None else self._transform(sample)


class RenderStream(IterableDataset[Any]):
    """Renders a recipe's frames while a training uses them.

    Each process of a data loader, and each rank of a distributed training, renders its own part of the frames, one
    after the other, and shows earlier ones again in between. What it renders goes to a cache on disk, which the next
    epoch reads. Once all frames of a rank are there, the end of an iteration makes its cache a dataset, and
    `droguekit merge` joins those of several ranks; `droguekit render` completes and describes it at any time.

    The order is a function of the recipe's seed, the epoch and the number of processes, not of how fast anything runs.

    Attributes:
        cache: folder of this rank's frames.
    """

    def __init__(
        self,
        recipe: Recipe,
        cache: str | Path,
        *,
        replays: int = 0,
        transform: Transform | None = None,
        rank: int = 0,
        ranks: int = 1,
        device: Device = "cpu",
    ) -> None:
        """Make the cache, or check that it belongs to the recipe.

        Args:
            recipe: from `droguekit.load_recipe`.
            cache: folder for the rendered frames; must be new, empty, or a dataset of the same recipe. Do not render
                into it by other means at the same time. With several ranks each has a folder of its own in it.
            replays: how many earlier frames follow each new one. With more, the training waits less for rendering.
            transform: changes each sample.
            rank: of this process in a distributed training.
            ranks: number of these processes.
            device: to render on: `cpu`, or `cuda` for an NVIDIA GPU.

        Raises:
            ValueError: numbers out of range, a folder that holds something else, or an engine or device that cannot be
                used.
            OSError: the folder cannot be written.
        """
        if "://" in str(cache) or not str(cache).strip():
            raise ValueError(f"cache: must be a folder of this machine, got {str(cache)!r}")
        if replays < 0:
            raise ValueError(f"replays: must not be negative, got {replays}")
        if not 0 <= rank < ranks:
            raise ValueError(f"rank: must be from 0 to ranks - 1 = {ranks - 1}, got {rank}")
        engine_notice(recipe.render.engine, device)
        self._recipe, self._device = recipe, device
        # Each rank locks and tidies a folder of its own, so that ranks may start at the same time.
        self.cache = Path(cache) if ranks == 1 else Path(cache) / f"rank-{rank:03d}"
        self._replays, self._transform = replays, transform
        self._rank, self._ranks = rank, ranks
        self._epoch, self._batches_done, self._batch_size = 0, 0, 1
        with open_dataset(self.cache, RecipeSource(recipe, RECIPE_TEXT), say=progress_report().say):
            if FrameStore(self.cache).pairs_per_tar is not None:
                raise ValueError(f"{cache}: keeps its pairs in tar files; give another folder for the cache")

    def start_at(self, epoch: int, batches_done: int = 0, batch_size: int = 1) -> None:
        """Choose where the next iteration begins, to go on with an interrupted training.

        Args:
            epoch: counted from 0; each has its own order of earlier frames.
            batches_done: number of batches of this epoch that this rank's data loader has delivered.
            batch_size: of the data loader, which must not drop incomplete batches (`drop_last`).

        Raises:
            ValueError: a negative number, or an empty batch.
        """
        if min(epoch, batches_done) < 0 or batch_size < 1:
            got = f"{epoch}, {batches_done}, {batch_size}"
            raise ValueError(f"epoch, batches_done, batch_size: must be at least 0, 0 and 1, got {got}")
        self._epoch, self._batches_done, self._batch_size = epoch, batches_done, batch_size

    def __iter__(self) -> Iterator[Any]:
        """The samples of this process, from the position that `start_at` chose.

        Raises:
            ValueError: a frame cannot be rendered.
            OSError: a frame or the description of the cache cannot be written.
        """
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        place, done = self._place(worker, workers)
        shard = self._rank * workers + place
        reader = Dataset(self.cache)
        task = FrameTask(self._recipe, self.cache, next(iter(reader.manifest.engines), None), device=self._device)
        for frame_index in self.frame_order(shard, self._ranks * workers, done):
            if not reader.frames.storage.exists(f"{frame_name(frame_index)}/{RECORD_FILE}"):
                task(frame_index)
            sample = sample_of_pair(stored_pair(reader, frame_index), keypoints=_most_markers(self._recipe))
            yield sample if self._transform is None else self._transform(sample)
        self._describe(reader.manifest, range(self._rank * workers, (self._rank + 1) * workers), self._ranks * workers)

    def _place(self, worker: int, workers: int) -> tuple[int, int]:
        """Whose part of the frames a process of this rank goes on with, and how many of its samples are done.

        A data loader takes batches from its processes in turn, from the first one on, and passes over those at their
        end. So the first process takes the part whose turn it is.
        """
        batches = [
            -(-self._samples(self._rank * workers + place, self._ranks * workers) // self._batch_size)
            for place in range(workers)
        ]
        turns = (place for turn in range(max(batches)) for place in range(workers) if turn < batches[place])
        done = Counter(islice(turns, self._batches_done))
        place = (next(turns, 0) + worker) % workers
        return place, done[place] * self._batch_size

    def _describe(self, manifest: Manifest, own_shards: range, shards: int) -> None:
        """Write manifest and annotations of the cache, once no process has a frame of this rank to make any more."""
        own = {index for index in range(self._recipe.frames.count) if index % shards in own_shards}
        if own <= {entry.frame_index for entry in manifest.frames} or not own <= set(list_frames(self.cache)):
            return
        with (self.cache / EVENTS_FILE).open("a", encoding="utf-8") as events:
            # Two processes may end at the same time: either describes the same frames.
            if try_lock(events):
                made_by, _ = join_build(self.cache, manifest)
                describe_dataset(self._recipe, self.cache, (), made_by)

    def frame_order(self, shard: int, shards: int, start: int = 0) -> Iterator[int]:
        """Indices of the frames that one of several processes shows in this epoch.

        Args:
            shard: which process, counted over all ranks.
            shards: number of processes.
            start: position to begin at.
        """
        own = range(shard, self._recipe.frames.count, shards)
        for position in range(start, self._samples(shard, shards)):
            newest, replay = divmod(position, 1 + self._replays)
            if replay == 0:
                yield own[newest]
            else:
                rng = sample_generator(self._recipe.seed, self._epoch, position, f"replay {shard} of {shards}")
                yield own[int(rng.integers(newest + 1))]

    def _samples(self, shard: int, shards: int) -> int:
        """How many samples a process shows in an epoch."""
        return len(range(shard, self._recipe.frames.count, shards)) * (1 + self._replays)
