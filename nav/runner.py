"""The navigation stack over a dataset that hides its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from datasets_manifest.blind import BlindDataset
from datasets_manifest.estimates import Estimate
from drogue_models.parameters import DrogueParameters
from nav.detector.interface import Detector
from nav.detector.registry import DEFAULT_DETECTOR, detector_factory
from nav.navigator import CENTROID_CHOICES, CentroidChoice, Navigator
from nav.pose.registry import method_names, pose_method

__all__ = ["CENTROID_CHOICES", "method_names", "navigate"]


def navigate(
    dataset: BlindDataset,
    methods: Sequence[str],
    centroids: CentroidChoice = "own",
    detector: str = DEFAULT_DETECTOR,
) -> Iterator[Estimate]:
    """Estimates of all methods for all pairs, frame by frame.

    Args:
        dataset: images, rig and drogue.
        methods: names from `method_names`.
        centroids: `own` for what each method measures on, `binary` or `edge` for all on the same.
        detector: a name from `nav.detector.registry.detector_names`, or a network's file.

    Yields:
        One estimate a frame and method, in that order.

    Raises:
        ValueError: a method or detector that does not exist, before any image is read, or an image that cannot be read.
    """
    for method in methods:
        pose_method(method)
    return _navigate(dataset, methods, centroids, detector_factory(detector))


def _navigate(
    dataset: BlindDataset,
    methods: Sequence[str],
    centroids: CentroidChoice,
    make_detector: Callable[[DrogueParameters], Detector],
) -> Iterator[Estimate]:
    for index in dataset.frame_indices:
        pair = dataset.pair(index)
        navigator = Navigator(pair.rig, pair.drogue, make_detector(pair.drogue), centroids)
        yield from navigator.estimate(pair.frame_index, pair.images, methods)
