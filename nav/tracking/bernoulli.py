"""Follows the drogue by N learned comparisons of pixel pairs about a Kalman filter's prediction.

In the spirit of the N-fold Bernoulli tracker, see `nav.tracking.pixel_comparison_features`. Ours: the tests are chosen
from more at the start, across colours too; `nav.tracking.appearance_model` brings the winner to a fraction of a
percent, and the tests have the last word on both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import Template
from nav.tracking.box_motion import BoxMotion, ExpectedBox
from nav.tracking.pixel_comparison_features import PairTests
from nav.tracking.region import (
    Box,
    EyeImage,
    ImageRegion,
    box_around,
    box_center,
    box_size,
    grown,
    image_region,
)

# The box is looked at on a grid that has so many pixels across it, enlarged where it is smaller.
_GRID = 32
# N: so many tests at a box of 16 px, in proportion to its size, and never more.
_LEAST_TESTS, _MOST_TESTS, _SMALL_BOX_PX = 64, 512, 16.0
# Tests are drawn anew for a box whose size asks for so many times as many.
_REDRAW = 2.0
_SEED = 20220714
# Candidates reach so many standard deviations of the innovation, at least so many box sides; a search that finds
# nothing is repeated this much wider in the same image.
_REACH_SD, _LEAST_REACH, _WIDENINGS = 3.0, 0.12, (1.0, 3.0)
# Farther than this, in pixels and box sides together, nothing is looked for: what moves on so far is a new detection.
_MOST_REACH_PX, _MOST_REACH = 64.0, 0.5
# First every second place of the grid by a quarter of the tests, then its neighbours by all.
_COARSE_STEP, _COARSE_SHARE = 2, 4
# Places that lie closer in a small box are told apart by its alignment.
_LEAST_STEP_PX = 1.0
_COARSE_LOG_SCALES = (0.0, -0.12, 0.12)
_SAME_SCALE = (0.0,)
_FINE_LOG_SCALES = (-0.06, 0.0, 0.06)
# Share of what the drogue reaches on average: below the first it is lost, above the second it is learned from.
_FOUND, _SURE = 0.5, 0.7
# The tests' noise between places that differ by less than their grid: an aligned box may score less by so much.
_ALIGNED_COST = 0.1
_MOST_MISSES = 5
# Smaller ones have no look of their own.
_LEAST_BOX_PX = 4.0
# A box that is better than ours by less than this, in box sides, is nothing new.
_SAME_BOX = 0.03


@dataclass(frozen=True, eq=False)
class _Find:
    box: Box
    score: float
    region: ImageRegion


class BernoulliEyeTracker:
    """One eye of the tracker `bernoulli`."""

    def __init__(self, image: EyeImage, box: Box) -> None:
        self._motion = BoxMotion(box, image.time_s)
        self._misses = 0
        self._box = box
        # By their boxes: which of them holds is only known after both eyes have looked.
        self._finds: dict[Box, _Find] = {}
        self._learn_anew(image, box)

    def look(self, image: EyeImage, predicted: Box | None, sd_px: float | None) -> Detection | None:
        """See `EyeTracker`."""
        if self._misses >= _MOST_MISSES and predicted is None:
            return None
        # Beyond a prediction that says how good it is there is nothing to look for.
        widenings = _WIDENINGS if sd_px is None else _WIDENINGS[:1]
        find = self._search(image, self._motion.expect(image.time_s, predicted, sd_px), widenings)
        if find is None:
            return None
        self._finds[find.box] = find
        return Detection(find.box, float(np.clip(find.score, 0, 1)))

    def learn(self, image: EyeImage, found: Detection | None) -> None:
        """See `EyeTracker`."""
        finds, self._finds = self._finds, {}
        if found is None:
            self._misses += 1
            return
        find = finds[found.box_xywh_px]
        self._misses, self._box = 0, find.box
        self._motion.update(find.box, image.time_s)
        if find.score > _SURE:
            self._tests.learn(find.region, find.box)
            self._template.learn(find.region, find.box)
            if _tests_for(find.box) > _REDRAW * self._tests.count:
                self._learn_anew(image, find.box)

    def correct(self, image: EyeImage, box: Box) -> None:
        """See `EyeTracker`; a box that differs begins a new template."""
        off = np.abs(np.subtract(box, self._box)).max() / box_size(box)
        if off > _SAME_BOX or self._misses > 0:
            self._motion = BoxMotion(box, image.time_s)
            self._learn_anew(image, box)
        else:
            self._motion.update(box, image.time_s)
        self._misses, self._box = 0, box

    def _learn_anew(self, image: EyeImage, box: Box) -> None:
        """Draw tests and take the template from a box."""
        region = image_region(image, grown(box, 1.4 * box[2], 1.4 * box[3]), box_size(box) / _GRID)
        assert region is not None
        self._tests = PairTests(region, box, _tests_for(box), np.random.default_rng(_SEED))
        self._template = Template(region, box)

    def _search(self, image: EyeImage, expected: ExpectedBox, widenings: tuple[float, ...]) -> _Find | None:
        """The best candidate, aligned, if it is the drogue; a wider search where it is not."""
        size = box_size(expected.box)
        if size < _LEAST_BOX_PX:
            return None
        most = _MOST_REACH_PX + _MOST_REACH * size
        for widening in widenings:
            reach = np.clip(widening * (_REACH_SD * expected.sd[:2] + _LEAST_REACH * size), 0, most)
            region = image_region(image, grown(expected.box, *(reach + 0.6 * size)), size / _GRID)
            if region is None:
                return None
            find = self._best(region, expected.box, reach, widening > 1)
            if find.score > _FOUND:
                return find
            if reach.min() >= most:
                return None
        return None

    def _best(self, region: ImageRegion, box: Box, reach: Array, is_wide: bool) -> _Find:
        """Coarse candidates, then fine ones about the winner, then its alignment, if the tests find that better."""
        step = max(_COARSE_STEP * box_size(box) / _GRID, _LEAST_STEP_PX)
        # Where the box was a moment ago its size is known well enough for the alignment.
        is_wide = is_wide or self._misses > 0
        scales = _COARSE_LOG_SCALES if is_wide else _SAME_SCALE
        coarse = _candidates(np.append(box_center(box), 0.0), reach, step, scales)
        fewer = max(_LEAST_TESTS // 2, self._tests.count // _COARSE_SHARE)
        start = coarse[int(np.argmax(self._tests.scores(region, box, coarse, fewer)))]
        fine = _candidates(start, np.full(2, step), step / _COARSE_STEP, _FINE_LOG_SCALES if is_wide else _SAME_SCALE)
        scores = self._tests.scores(region, box, fine)
        best = int(np.argmax(scores))
        if not scores[best] > _FOUND / 2:
            return _Find(box, -np.inf, region)
        scale = float(np.exp(fine[best, 2]))
        found = box_around(fine[best, :2], box[2] * scale, box[3] * scale)
        aligned = self._template.align(region, found)
        score = float(self._tests.scores(region, aligned, np.append(box_center(aligned), 0.0)[None])[0])
        if score >= scores[best] - _ALIGNED_COST and score > _FOUND:
            return _Find(aligned, score, region)
        return _Find(found, float(scores[best]), region)


def _tests_for(box: Box) -> int:
    return int(np.clip(_LEAST_TESTS * box_size(box) / _SMALL_BOX_PX, _LEAST_TESTS, _MOST_TESTS))


def _candidates(start: Array, reach: Array, step_px: float, log_scales: tuple[float, ...]) -> Array:
    """(P, 3) middles on a grid about a start, with several log-scales."""
    counts = np.ceil(reach / step_px - 1e-9).astype(int)
    x, y = (step_px * np.arange(-count, count + 1) for count in counts)
    grid = np.stack(np.meshgrid(x, y, log_scales), axis=-1).reshape(-1, 3)
    candidates: Array = start + grid
    return candidates
