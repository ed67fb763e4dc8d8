"""Trains the detector on a stream of renders, and tells which share of the time it waited for pairs.

`python -m studies.training_feed --out out/training-feed`
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Literal

import torch
from torch.utils.data import DataLoader

from datasets_manifest.recipe.recipe import Recipe
from droguekit.api.recipe_rendering import load_recipe
from droguekit.torch import RenderStream, Sample
from nav.detector.network.head import detection_loss
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from studies.wrong_input import wrong_input_ends

# The seed paper's network input.
HEIGHT_PX, WIDTH_PX = 320, 416
_RECIPE = "detector-small"


@dataclass(frozen=True)
class Feed:
    """Times of one epoch.

    Attributes:
        steps: that were trained, without the first.
        start_s: until the first batch came. [s]
        waiting_s: for the other batches. [s]
        training_s: in the other steps. [s]
    """

    steps: int
    start_s: float
    waiting_s: float
    training_s: float

    @property
    def fed_fraction(self) -> float:
        """Share of the time after the first batch in which the training did not wait."""
        return self.training_s / (self.training_s + self.waiting_s)

    def line(self, name: str) -> str:
        """The times as a line."""
        return (
            f"{name}: {self.steps} steps, first batch after {self.start_s:.1f} s; then {self.training_s:.1f} s of "
            f"training and {self.waiting_s:.1f} s of waiting: fed {100 * self.fed_fraction:.1f} % of the time"
        )


def feed_recipe(pairs: int) -> Recipe:
    """The detector's small corpus at the network's size."""
    # The same field of view as the corpus.
    camera = load_recipe(_RECIPE).rig.camera
    focal_px = camera.fx_px * WIDTH_PX / camera.width_px
    rig = {
        "preset": "rgb-ideal",
        "width_px": WIDTH_PX,
        "height_px": HEIGHT_PX,
        "focal_px": focal_px,
        "encoding": "gamma",
    }
    return load_recipe(_RECIPE, rig=rig, frames={"count": pairs, "scenes": min(pairs, 20)})


def left_and_right(sample: Sample) -> tuple[torch.Tensor, torch.Tensor]:
    """(2, 3, H, W) images between 0 and 1, and (2, 4) boxes, NaN without a drogue. [px]"""
    return torch.stack([sample["left"], sample["right"]]).float() / 255, sample["boxes_px"]


def measure_epoch(stream: RenderStream, batch_pairs: int, network: DetectorNetwork, workers: int = 1) -> Feed:
    """Train one epoch, and time it."""
    loader: DataLoader[tuple[torch.Tensor, torch.Tensor]] = DataLoader(
        stream,
        batch_size=batch_pairs,
        num_workers=workers,
        multiprocessing_context="spawn" if workers else None,
        prefetch_factor=8 if workers else None,
    )
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-3)
    waiting, training = [], []
    for waited_s, images, boxes in _timed_batches(loader):
        step_s = perf_counter()
        flat = boxes.reshape(-1, 4)
        truth = [row[None] if torch.isfinite(row).all() else row[:0].reshape(0, 4) for row in flat]
        loss = detection_loss(network(images.flatten(0, 1)), truth)
        optimizer.zero_grad(set_to_none=True)
        loss.total.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        waiting.append(waited_s)
        training.append(perf_counter() - step_s)
    if len(training) < 2:
        raise ValueError(f"--pairs: an epoch of {len(training)} steps is too short to measure; give more pairs")
    return Feed(len(training) - 1, waiting[0], sum(waiting[1:]), sum(training[1:]))


def _timed_batches(
    loader: DataLoader[tuple[torch.Tensor, torch.Tensor]],
) -> Iterator[tuple[float, torch.Tensor, torch.Tensor]]:
    """Batches with the time that each was waited for. [s]"""
    asked_s = perf_counter()
    for images, boxes in loader:
        yield perf_counter() - asked_s, images, boxes
        asked_s = perf_counter()


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure an epoch that renders, and one that reads what it left."""
    parser = argparse.ArgumentParser(prog="python -m studies.training_feed", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the cache; an empty one")
    parser.add_argument("--pairs", type=int, default=24, metavar="N", help="pairs that are rendered (default 24)")
    parser.add_argument(
        "--replays", type=int, default=15, metavar="N", help="earlier pairs after each new one (default 15)"
    )
    parser.add_argument("--batch-pairs", type=int, default=4, metavar="N", help="pairs in a batch (default 4)")
    parser.add_argument("--variant", choices=("s", "l"), default="s", help="of the network (default s)")
    options = parser.parse_args(arguments)
    with wrong_input_ends("training_feed"):
        _measure(options.out, options.pairs, options.replays, options.batch_pairs, options.variant)


def _measure(out: Path, pairs: int, replays: int, batch_pairs: int, variant: Literal["s", "l"]) -> None:
    if pairs < 1 or batch_pairs < 1 or replays < 0:
        raise ValueError("--pairs, --batch-pairs: must be at least 1; --replays: must be at least 0")
    torch.manual_seed(0)
    # One core for the training, and the rest for the process that renders.
    torch.set_num_threads(1)
    network = DetectorNetwork(NetworkConfig(variant)).train()
    stream = RenderStream(feed_recipe(pairs), out, replays=replays, transform=left_and_right)
    for epoch, name in enumerate(("new and earlier pairs", "pairs of the cache alone")):
        stream.start_at(epoch)
        print(measure_epoch(stream, batch_pairs, network).line(name), flush=True)


if __name__ == "__main__":
    main()
