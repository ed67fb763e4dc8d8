"""The navigation stack over a dataset that hides its truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from datasets_manifest.blind import BlindDataset
from datasets_manifest.estimates import Estimate
from nav.navigator import Navigator
from nav.pose.registry import method_names, pose_method

__all__ = ["method_names", "navigate"]


def navigate(dataset: BlindDataset, methods: Sequence[str]) -> Iterator[Estimate]:
    """Estimates of all methods for all pairs, frame by frame.

    Args:
        dataset: images, rig and drogue.
        methods: names from `method_names`.

    Yields:
        One estimate a frame and method, in that order.

    Raises:
        ValueError: a method that does not exist, before any image is read, or an image that cannot be read.
    """
    for method in methods:
        pose_method(method)
    return _navigate(dataset, methods)


def _navigate(dataset: BlindDataset, methods: Sequence[str]) -> Iterator[Estimate]:
    for index in dataset.frame_indices:
        pair = dataset.pair(index)
        yield from Navigator(pair.rig, pair.drogue).estimate(pair.frame_index, pair.images, methods)
