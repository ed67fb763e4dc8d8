"""Tracker `bernoulli`: N learned comparisons of pixel pairs, evaluated about a Kalman filter's prediction.

In the spirit of the N-fold Bernoulli tracker, see `nav.tracking.pixel_comparison_features`. Different here: the
comparisons are selected from a larger number at the start, also across colours; the best box is aligned to a fraction
of a percent by `nav.tracking.appearance_model`, and the comparisons decide between it and the aligned box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import AlignmentTemplate
from nav.tracking.box_motion import BoxMotion, PredictedBox
from nav.tracking.pixel_comparison_features import PixelComparisonFeatures
from nav.tracking.region import (
    Box,
    EyeImage,
    ImageRegion,
    box_center,
    box_from_center,
    box_size,
    expand_box,
    image_region,
)

# The box is resampled to a grid with this many pixels across it.
_GRID = 32
# Number of comparisons: the first for a box of 16 px, in proportion to its size, at most the second.
_LEAST_FEATURES, _MOST_FEATURES, _SMALL_BOX_PX = 64, 512, 16.0
# Comparisons are drawn anew for a box whose size asks for more than this many times as many.
_REDRAW = 2.0
_SEED = 20220714
# The search reaches this many standard deviations of the innovation, and at least this many box sides; a search that
# finds nothing is repeated with the next factor on its reach.
_REACH_SD, _SMALLEST_REACH, _REACH_FACTORS = 3.0, 0.12, (1.0, 3.0)
# Largest reach, the sum of pixels and box sides: a drogue that moved farther needs a new detection.
_LARGEST_REACH_PX, _LARGEST_REACH = 64.0, 0.5
# First every second grid point by a quarter of the comparisons, then the neighbours of the best by all of them.
_COARSE_STEP, _COARSE_SHARE = 2, 4
# In small boxes the alignment resolves what is closer.
_LEAST_STEP_PX = 1.0
_COARSE_LOG_SCALES = (0.0, -0.12, 0.12)
_SAME_SCALE = (0.0,)
_FINE_LOG_SCALES = (-0.06, 0.0, 0.06)
# Scores, 1 for the drogue on average: below the first it is lost, above the second the tracker learns from the box.
_LEAST_SCORE, _LEARNING_SCORE = 0.5, 0.7
# Noise of scores within one grid step: an aligned box may score less by this much.
_SCORE_NOISE = 0.1
_MOST_MISSES = 5
# Smaller boxes have too little texture.
_LEAST_BOX_PX = 4.0
# A correction by less than this, in box sides, does not restart the tracker.
_SAME_BOX = 0.03


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A box that was found in a region, and its score."""

    box: Box
    score: float
    region: ImageRegion


class BernoulliEyeTracker:
    """One eye of the tracker `bernoulli`."""

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._motion = BoxMotion(box, image.time_s)
        self._misses = 0
        self._box = box
        # Keyed by their boxes: which of them is accepted is known only after both eyes were searched.
        self._candidates_by_box: dict[Box, _Candidate] = {}
        self._restart(image, box)

    def locate(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`."""
        if self._misses >= _MOST_MISSES and predicted is None:
            return None
        # A prediction with a standard deviation needs no wider search.
        reach_factors = _REACH_FACTORS if sd_px is None else _REACH_FACTORS[:1]
        best = self._search(image, self._motion.predict(image.time_s, predicted, sd_px), reach_factors)
        if best is None:
            return None
        self._candidates_by_box[best.box] = best
        return Detection(best.box, float(np.clip(best.score, 0, 1)))

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        candidates, self._candidates_by_box = self._candidates_by_box, {}
        if found is None:
            self._misses += 1
            return
        best = candidates[found.box_xywh_px]
        self._misses, self._box = 0, best.box
        self._motion.update(best.box, image.time_s)
        if best.score > _LEARNING_SCORE:
            self._features.learn(best.region, best.box)
            self._template.learn(best.region, best.box)
            if _feature_count(best.box) > _REDRAW * self._features.count:
                self._restart(image, best.box)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`; a box that differs restarts the comparisons and the template."""
        change = np.abs(np.subtract(box, self._box)).max() / box_size(box)
        if change > _SAME_BOX or self._misses > 0:
            self._motion = BoxMotion(box, image.time_s)
            self._restart(image, box)
        else:
            self._motion.update(box, image.time_s)
        self._misses, self._box = 0, box

    def _restart(self, image: EyeImage, box: Box) -> None:
        """Draw comparisons and take the template from a box."""
        region = image_region(image, expand_box(box, 1.4 * box[2], 1.4 * box[3]), box_size(box) / _GRID)
        assert region is not None
        self._features = PixelComparisonFeatures(region, box, _feature_count(box), np.random.default_rng(_SEED))
        self._template = AlignmentTemplate(region, box)

    def _search(self, image: EyeImage, predicted: PredictedBox, reach_factors: tuple[float, ...]) -> _Candidate | None:
        """The best candidate if it is the drogue; a wider search where it is not."""
        size = box_size(predicted.box)
        if size < _LEAST_BOX_PX:
            return None
        largest_reach = _LARGEST_REACH_PX + _LARGEST_REACH * size
        for reach_factor in reach_factors:
            reach = np.clip(reach_factor * (_REACH_SD * predicted.sd[:2] + _SMALLEST_REACH * size), 0, largest_reach)
            region = image_region(image, expand_box(predicted.box, *(reach + 0.6 * size)), size / _GRID)
            if region is None:
                return None
            best = self._best_candidate(region, predicted.box, reach, reach_factor > 1)
            if best.score > _LEAST_SCORE:
                return best
            if reach.min() >= largest_reach:
                return None
        return None

    def _best_candidate(self, region: ImageRegion, box: Box, reach: Array, is_wide: bool) -> _Candidate:
        """Coarse candidates, then fine ones about the best, then its alignment if that scores as well."""
        step = max(_COARSE_STEP * box_size(box) / _GRID, _LEAST_STEP_PX)
        # After a successful last search the size is known well enough for the alignment.
        is_wide = is_wide or self._misses > 0
        scales = _COARSE_LOG_SCALES if is_wide else _SAME_SCALE
        coarse = _candidate_grid(np.append(box_center(box), 0.0), reach, step, scales)
        coarse_features = max(_LEAST_FEATURES // 2, self._features.count // _COARSE_SHARE)
        start = coarse[int(np.argmax(self._features.scores(region, box, coarse, coarse_features)))]
        fine = _candidate_grid(
            start, np.full(2, step), step / _COARSE_STEP, _FINE_LOG_SCALES if is_wide else _SAME_SCALE
        )
        scores = self._features.scores(region, box, fine)
        best = int(np.argmax(scores))
        if not scores[best] > _LEAST_SCORE / 2:
            return _Candidate(box, -np.inf, region)
        scale = float(np.exp(fine[best, 2]))
        found = box_from_center(fine[best, :2], box[2] * scale, box[3] * scale)
        aligned = self._template.align(region, found)
        score = float(self._features.scores(region, aligned, np.append(box_center(aligned), 0.0)[None])[0])
        if score >= scores[best] - _SCORE_NOISE and score > _LEAST_SCORE:
            return _Candidate(aligned, score, region)
        return _Candidate(found, float(scores[best]), region)


def _feature_count(box: Box) -> int:
    return int(np.clip(_LEAST_FEATURES * box_size(box) / _SMALL_BOX_PX, _LEAST_FEATURES, _MOST_FEATURES))


def _candidate_grid(start: Array, reach: Array, step_px: float, log_scales: tuple[float, ...]) -> Array:
    """(P, 3) centres on a grid about a start, with several log-scales."""
    counts = np.ceil(reach / step_px - 1e-9).astype(int)
    x, y = (step_px * np.arange(-count, count + 1) for count in counts)
    grid = np.stack(np.meshgrid(x, y, log_scales), axis=-1).reshape(-1, 3)
    candidates: Array = start + grid
    return candidates
