"""A detector over all pairs of a dataset, without the truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

import numpy as np

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.storage.pair_faults import PairFaults, fault_reason, unreadable_reason
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.images import StereoImages
from drogue_models.parameters import DrogueParameters
from droguekit.scoring.results.detection_result import DetectedBox, PairTimes, clipped_box, corner_box, image_id_of
from geometry.stereo import EYES
from nav.detector.detector import Detector
from nav.tracked_detection import TrackedDetector

LEAST_SCORE = 0.001
"""Boxes with at least this score are kept: average precision needs low scores too."""


class DetectorRunner:
    """Runs a detector once over every pair.

    Attributes:
        name: of the detector.
        pairs: how many there are.
        score_threshold: the detector's own threshold, or None.
        pass_sizes_px: width and height of a network's input in each of its passes; none where there is no network. [px]
        wall_s, cpu_s: time of each processed pair, without reading its images. [s]
        faults: of pairs that cannot be read or in which the detector fails; they have no boxes.
    """

    def __init__(
        self,
        dataset: Location,
        detector_of: Callable[[DrogueParameters], Detector],
        frame_indices: Sequence[int] | None = None,
    ) -> None:
        """Open the dataset.

        Args:
            dataset: its folder or URL.
            detector_of: the detector of a drogue; pairs may name different ones.
            frame_indices: pairs to process, all by default.

        Raises:
            ValueError: no such dataset, or one without pairs.
        """
        self._dataset = BlindDataset(dataset)
        self._detector_of = detector_of
        self._frame_indices = self._dataset.frame_indices if frame_indices is None else tuple(frame_indices)
        self.pairs = len(self._frame_indices)
        if not self.pairs:
            raise ValueError(f"{dataset}: has no pairs")
        first = detector_of(self._first_drogue())
        self._latest = first
        self.name = first.name
        # Only networks name one.
        metadata = getattr(first, "metadata", None)
        self.score_threshold: float | None = None if metadata is None else metadata.score_threshold
        self.pass_sizes_px: tuple[tuple[int, int], ...] = getattr(first, "pass_sizes_px", ())
        self.wall_s: list[float] = []
        self.cpu_s: list[float] = []
        self.faults = PairFaults()

    def boxes(self, least_score: float, advance: Callable[[], None]) -> Iterator[DetectedBox]:
        """Boxes of all images, clipped to them, pair by pair.

        Args:
            least_score: boxes that score less are left out.
            advance: called after each pair.
        """
        for index in self._frame_indices:
            try:
                pair = self._dataset.pair(index)
            except ValueError as error:
                self.faults.note(index, unreadable_reason(index, error))
                self._end_sequence()
            else:
                self._latest = self._detector_of(pair.drogue)
                yield from self._detect(index, self._latest, pair.images, least_score)
            advance()

    def times(self) -> PairTimes:
        """Median times of the pairs so far.

        Raises:
            ValueError: the work on every pair ended by a fault; tells the first.
        """
        if not self.wall_s:
            raise ValueError(self.faults.line() or "no pair was processed")
        wall_ms, cpu_ms = (1e3 * float(np.median(seconds)) for seconds in (self.wall_s, self.cpu_s))
        return PairTimes(wall_ms=wall_ms, cpu_ms=cpu_ms, pairs=len(self.wall_s))

    def _first_drogue(self) -> DrogueParameters:
        """The drogue of the first pair whose record can be read: the others are faults when their turn comes."""
        for index in self._frame_indices:
            with suppress(ValueError):
                return self._dataset.sought_drogue(index)
        return self._dataset.drogue

    def _detect(
        self, index: int, detector: Detector, images: StereoImages, least_score: float
    ) -> Iterator[DetectedBox]:
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        try:
            found = detector.candidates(images, least_score)
        except Exception as error:
            self.faults.note(index, fault_reason(index, error))
            self._end_sequence()
            return
        self.wall_s.append(time.perf_counter() - wall_s)
        self.cpu_s.append(time.process_time() - cpu_s)
        for eye in EYES:
            for detection in found.get(eye, ()):
                box = clipped_box(corner_box(detection.box_xywh_px), images.size_px)
                if box is not None:
                    yield DetectedBox(image_id_of(index, eye), box, detection.score)

    def _end_sequence(self) -> None:
        """Let no tracker follow the drogue across a pair without a result."""
        if isinstance(self._latest, TrackedDetector):
            self._latest.restart()
