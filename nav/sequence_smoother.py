"""Smoothed estimates of sequences, each of them once it is over."""

from __future__ import annotations

from datasets_manifest.types.estimates import Estimate, NoFix
from drogue_models.marker_layout import marker_layout
from nav.docking import docking_of
from nav.filtering.smoother import SMOOTHER_SUFFIX, smooth
from nav.sequence_navigator import PairAnswers, SequenceSettings


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
