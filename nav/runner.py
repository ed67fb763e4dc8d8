"""Navigation over a dataset that hides its truth: estimates pair by pair, smoothed ones after each sequence."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.pair_faults import unreadable_reason
from datasets_manifest.types.estimates import Estimate, NoFix
from drogue_models.marker_layout import marker_layout
from nav.detector.detector_registry import DEFAULT_DETECTOR, detector_factory
from nav.docking import docking_quantities
from nav.filtering.roll_decoder import DecodedRoll, turned_to, with_own_numbers
from nav.filtering.smoother import SMOOTHER_SUFFIX, smooth
from nav.pair_navigator import CENTROID_CHOICES, CentroidChoice
from nav.pose.method_registry import method_names, pose_method
from nav.sequence_navigator import PairEstimates, SequenceNavigator, SequenceSettings, SkippedPair


class SequenceSmoother:
    """Collects the estimates of a sequence and smooths them when the next one begins."""

    def __init__(self, settings: SequenceSettings) -> None:
        """Create a smoother without pairs."""
        self._settings = settings
        self._pairs: list[PairEstimates] = []

    def add(self, pair: PairEstimates) -> list[Estimate]:
        """Add the estimates of the next pair.

        Returns:
            Smoothed estimates of the previous sequence where this pair begins another one; else nothing.
        """
        smoothed = self.finish() if pair.begins else []
        self._pairs.append(pair)
        return smoothed

    def finish(self) -> list[Estimate]:
        """Smoothed estimates of the finished sequence, method by method within each pair."""
        pairs, self._pairs = self._pairs, []
        if not pairs:
            return []
        times_s = [pair.time_s for pair in pairs]
        order = marker_layout(pairs[0].drogue).symmetry_order
        by_method = []
        for place in range(len(self._settings.methods)):
            measured = [pair.estimates[place] for pair in pairs]
            smoothed = smooth(times_s, measured, self._settings.motion, order)
            by_method.append([self._with_docking(*each) for each in zip(pairs, measured, smoothed, strict=True)])
        return [estimate for estimates in zip(*by_method, strict=True) for estimate in estimates]

    def _with_docking(self, pair: PairEstimates, measured: Estimate, smoothed: Estimate) -> Estimate:
        """The smoothed estimate with docking quantities; no pose for a pair in which the drogue was not seen.

        It has no latency, since it follows only after the end of the sequence.
        """
        if isinstance(smoothed, NoFix):
            return smoothed.model_copy(update={"latency_s": None, "time_s": measured.time_s})
        if isinstance(measured, NoFix):
            return measured.model_copy(update={"method": measured.method + SMOOTHER_SUFFIX, "latency_s": None})
        if measured.roll_probability is not None:
            roll = DecodedRoll(measured.left_from_drogue, measured.roll_probability)
            smoothed = turned_to(smoothed, pair.drogue, roll)
        smoothed = with_own_numbers(smoothed, measured, pair.drogue)
        docking = docking_quantities(smoothed, pair.rig, pair.drogue, self._settings.capture_radius_m)
        return smoothed.model_copy(update={"docking": docking, "latency_s": None, "time_s": measured.time_s})


LATE = "late: newer images had come before this pair could be worked on"

__all__ = ["CENTROID_CHOICES", "add_smoothed", "method_names", "navigate", "open_navigator", "process_dataset"]


def navigate(
    dataset: BlindDataset,
    methods: Sequence[str],
    centroids: CentroidChoice = "own",
    detector: str = DEFAULT_DETECTOR,
) -> Iterator[Estimate]:
    """Estimates of all methods for all pairs, frame by frame, each pair by itself.

    Args:
        dataset: images, rig and drogue.
        methods: names from `method_names`.
        centroids: `own` for the centroids that each method is made for, `binary` or `edge` for the same ones for all.
        detector: see `detector_factory`.

    Yields:
        One estimate per frame and method, in that order; no fix, with the reason, for a pair that cannot be read.

    Raises:
        ValueError: a method or detector that does not exist, before any image is read.
    """
    settings = SequenceSettings(tuple(methods), centroids)
    return add_smoothed(process_dataset(dataset, open_navigator(settings, detector)), settings)


def open_navigator(settings: SequenceSettings, detector: str | None = None) -> SequenceNavigator:
    """Create a navigator for a sequence of pairs.

    Args:
        settings: what it measures.
        detector: see `detector_factory`; by default ours.

    Raises:
        ValueError: a method, detector or tracker that does not exist, or a setting out of range.
    """
    for method in settings.methods:
        pose_method(method)
    return SequenceNavigator(settings, detector_factory(DEFAULT_DETECTOR if detector is None else detector))


def process_dataset(dataset: BlindDataset, navigator: SequenceNavigator) -> Generator[PairEstimates | SkippedPair]:
    """Estimates of all pairs of a dataset, computed lazily; a pair that cannot be read is skipped with its fault."""
    for index in dataset.frame_indices:
        try:
            pair = dataset.pair(index)
        except ValueError as error:
            navigator.restart()
            yield SkippedPair(index, unreadable_reason(index, error))
        else:
            yield navigator.process(pair)


def add_smoothed(pairs: Iterable[PairEstimates | SkippedPair], settings: SequenceSettings) -> Iterator[Estimate]:
    """All estimates, and after each sequence its smoothed ones where the settings ask for them."""
    smoother = SequenceSmoother(settings) if settings.smoothed else None
    for each in pairs:
        if isinstance(each, SkippedPair):
            reason = each.fault or LATE
            yield from (NoFix(frame_index=each.frame_index, method=name, reason=reason) for name in settings.names)
            continue
        if smoother is not None:
            yield from smoother.add(each)
        yield from each.estimates
    if smoother is not None:
        yield from smoother.finish()
