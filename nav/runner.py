"""The navigation stack over a dataset that hides its truth."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.types.estimates import Estimate, NoFix
from drogue_models.marker_layout import marker_layout
from nav.detector.detector_registry import DEFAULT_DETECTOR, detector_factory
from nav.docking import docking_of
from nav.filtering.smoother import SMOOTHER_SUFFIX, smooth
from nav.navigator import CENTROID_CHOICES, CentroidChoice
from nav.pose.pose_methods import method_names, pose_method
from nav.sequence_navigator import LatePair, PairAnswers, SequenceNavigator, SequenceSettings


class SequenceSmoother:
    """Collects the answers of a sequence and smooths them when the next one begins."""

    def __init__(self, settings: SequenceSettings) -> None:
        """Begin before the first pair."""
        self._settings = settings
        self._answers: list[PairAnswers] = []

    def add(self, answers: PairAnswers) -> list[Estimate]:
        """Take the answers to the next pair.

        Returns:
            Smoothed estimates of the sequence before, where another one begins; else nothing.
        """
        smoothed = self.finish() if answers.begins else []
        self._answers.append(answers)
        return smoothed

    def finish(self) -> list[Estimate]:
        """Smoothed estimates of the sequence that is over, method by method within each pair."""
        over, self._answers = self._answers, []
        if not over:
            return []
        times_s = [answers.time_s for answers in over]
        order = marker_layout(over[0].drogue).symmetry_order
        by_method = []
        for place in range(len(self._settings.methods)):
            measured = [answers.estimates[place] for answers in over]
            smoothed = smooth(times_s, measured, self._settings.motion, order)
            by_method.append([self._told(*each) for each in zip(over, measured, smoothed, strict=True)])
        return [estimate for pair in zip(*by_method, strict=True) for estimate in pair]

    def _told(self, answers: PairAnswers, measured: Estimate, smoothed: Estimate) -> Estimate:
        """A smoothed estimate with docking quantities; none for a pair in which the drogue was not seen.

        No latency: it comes when the sequence is over.
        """
        if isinstance(smoothed, NoFix):
            return smoothed.model_copy(update={"latency_s": None})
        if isinstance(measured, NoFix):
            return measured.model_copy(update={"method": measured.method + SMOOTHER_SUFFIX, "latency_s": None})
        docking = docking_of(smoothed, answers.rig, answers.drogue, self._settings.capture_radius_m)
        return smoothed.model_copy(update={"docking": docking, "latency_s": None})


LATE = "late: newer images had come before this pair could be worked on"

__all__ = ["CENTROID_CHOICES", "answers_of", "method_names", "navigate", "open_navigator", "with_smoothed"]


def navigate(
    dataset: BlindDataset,
    methods: Sequence[str],
    centroids: CentroidChoice = "own",
    detector: str = DEFAULT_DETECTOR,
) -> Iterator[Estimate]:
    """Estimates of all methods for all pairs, frame by frame, each pair for itself.

    Args:
        dataset: images, rig and drogue.
        methods: names from `method_names`.
        centroids: `own` for what each method measures on, `binary` or `edge` for all on the same.
        detector: a name from `nav.detector.detector_registry.detector_names`, or a network's file.

    Yields:
        One estimate a frame and method, in that order.

    Raises:
        ValueError: a method or detector that does not exist, before any image is read, or an image that cannot be read.
    """
    settings = SequenceSettings(tuple(methods), centroids)
    return with_smoothed(answers_of(dataset, open_navigator(settings, detector)), settings)


def open_navigator(settings: SequenceSettings, detector: str) -> SequenceNavigator:
    """A navigator before its first pair.

    Raises:
        ValueError: a method, detector, tracker or setting that cannot be.
    """
    for method in settings.methods:
        pose_method(method)
    return SequenceNavigator(settings, detector_factory(detector))


def answers_of(dataset: BlindDataset, navigator: SequenceNavigator) -> Generator[PairAnswers]:
    """Answers to all pairs of a dataset, each when it is asked for."""
    return (navigator.answer(dataset.pair(index)) for index in dataset.frame_indices)


def with_smoothed(answers: Iterable[PairAnswers | LatePair], settings: SequenceSettings) -> Iterator[Estimate]:
    """The estimates of all answers, and the smoothed ones of each sequence after it where the settings ask for them."""
    smoother = SequenceSmoother(settings) if settings.smoothed else None
    for each in answers:
        if isinstance(each, LatePair):
            yield from (NoFix(frame_index=each.frame_index, method=name, reason=LATE) for name in settings.names)
            continue
        if smoother is not None:
            yield from smoother.add(each)
        yield from each.estimates
    if smoother is not None:
        yield from smoother.finish()
