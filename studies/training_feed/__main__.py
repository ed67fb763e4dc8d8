"""Trains the detector on a stream of renders, and tells which share of the time it waited for pairs.

`python -m studies.training_feed --out out/training-feed`
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from droguekit.torch import RenderStream
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from studies.training_feed.epoch_feed import feed_recipe, left_and_right, measure_epoch


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
    torch.manual_seed(0)
    # One core for the training, and the rest for the process that renders.
    torch.set_num_threads(1)
    network = DetectorNetwork(NetworkConfig(options.variant)).train()
    stream = RenderStream(feed_recipe(options.pairs), options.out, replays=options.replays, transform=left_and_right)
    for epoch, name in enumerate(("new and earlier pairs", "pairs of the cache alone")):
        stream.start_at(epoch)
        print(measure_epoch(stream, options.batch_pairs, network).line(name), flush=True)


if __name__ == "__main__":
    main()
