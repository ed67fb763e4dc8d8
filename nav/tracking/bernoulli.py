"""Tracker `bernoulli`: N learned comparisons of pixel pairs, evaluated about a Kalman filter's prediction.

Each comparison has learned pass rates (Bernoulli probabilities) on the drogue and beside it. Inspired by the title of
Rasol et al., "N-fold Bernoulli probability based adaptive fast-tracking algorithm and its application to autonomous
aerial refueling", doi:10.1016/j.cja.2022.07.014, whose text was not available; no re-implementation. Different here:
the comparisons are selected from a larger number at the start, also across colours; the best box is aligned to a
fraction of a percent by `nav.tracking.appearance_model`, and the comparisons decide between it and the aligned box.
Binary tests of pixel pairs: Calonder et al., doi:10.1007/978-3-642-15561-1_56.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.detector.detector import Detection
from nav.tracking.appearance_model import AlignmentTemplate
from nav.tracking.box_motion import BoxMotion, PredictedBox
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

# Points lie in a disc of this radius about the box's centre, in box sides: the rim and a little beyond.
_RADIUS = 0.58
_DRAWN_PER_SELECTED = 4
# A comparison passes where one pixel exceeds the other by this share of the drogue's own contrast, and by this many
# levels: a uniform sky passes none while its noise stays below that.
_MARGIN_FRACTION = 0.12
_LEAST_MARGIN = 3
# Factor on the weight of old counts at each update.
_FORGETTING = 0.98
# Pass rates stay within this of 0 and 1.
_SMALLEST_RATE = 0.03
# Offsets that still count as on the drogue, in box sides and as a log-scale ...
_OFFSET, _LOG_SCALE_OFFSET = 1 / 32, 0.04
# ... and those that count as beside it: eight centres around it at each of these distances in box sides, and the
# box's own centre with each of these log-scales.
_BESIDE_DISTANCES = (0.45, 0.8, 1.3)
_WRONG_LOG_SCALES = (-0.5, -0.3, 0.3, 0.5)
# Each update uses every third of these, since they change little. Three has no factor in common with the eight
# directions, so that all directions are used.
_LEARNED_BESIDE = 3
# Smallest share of the expected score that must be on the image.
_LEAST_SEEN = 0.4


class PixelComparisonFeatures:
    """N pixel comparisons of one drogue in one eye.

    Attributes:
        count: N.
    """

    def __init__(self, region: ImageRegion, box: Box, count: int, rng: np.random.Generator) -> None:
        """Draw comparisons, and select those that best separate the box's content from its surroundings.

        Args:
            region: the box and at least its own size around, where the image has it.
            box: the drogue's. [px]
            count: comparisons to select.
            rng: for the draw.
        """
        drawn = count * _DRAWN_PER_SELECTED
        angle, radius = rng.uniform(0, 2 * np.pi, (2, drawn)), _RADIUS * np.sqrt(rng.uniform(0, 1, (2, drawn)))
        self._points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        self._planes = rng.integers(0, region.pixels.shape[2], (2, drawn))
        center = _box_candidate(box)
        self._margin = _LEAST_MARGIN
        values, _ = self._pixel_pairs(region, box, center)
        self._margin = max(_LEAST_MARGIN, int(_MARGIN_FRACTION * np.ptp(np.percentile(values, (5, 95)))))
        # Order each pair so that the drogue passes it.
        swapped = values[0, 0] < values[1, 0]
        self._points[:, swapped] = self._points[::-1, swapped]
        self._planes[:, swapped] = self._planes[::-1, swapped]
        on_drogue, beside = _on_candidates(box), _beside_candidates(box)
        self._on_counts = 1 + self._count_passes(region, box, on_drogue)
        self._beside_counts = 1 + self._count_passes(region, box, beside)
        best = np.argsort(-self._divergence(), kind="stable")[:count]
        self._points, self._planes = self._points[:, best], self._planes[:, best]
        self._on_counts, self._beside_counts = self._on_counts[:, best], self._beside_counts[:, best]
        self.count = count

    def scores(self, region: ImageRegion, box: Box, candidates: Array, count: int | None = None) -> Array:
        """Log-likelihood ratio of drogue against surroundings, as a share of its expected value on the drogue.

        Args:
            region: where to look.
            box: of which the candidates are copies. [px]
            candidates: (P, 3) centres [px] and log-scales against the box.
            count: use only this many comparisons, the best first; all by default.

        Returns:
            (P,) 1 on the drogue, on average; minus infinity where too little of a candidate is on the image.
        """
        subset = slice(0, self.count if count is None else count)
        passed, valid = self._evaluate(region, box, candidates, subset)
        on_drogue, beside = _pass_rate(self._on_counts[:, subset]), _pass_rate(self._beside_counts[:, subset])
        gain, loss = (
            np.log(on_drogue / beside).astype(np.float32),
            np.log((1 - on_drogue) / (1 - beside)).astype(np.float32),
        )
        expected = (on_drogue * gain + (1 - on_drogue) * loss).astype(np.float32)
        # Matrix products of booleans are slow.
        valid32 = valid.astype(np.float32)
        reached = (passed & valid).astype(np.float32) @ (gain - loss) + valid32 @ loss
        seen = valid32 @ expected
        enough = seen >= _LEAST_SEEN * expected.sum()
        share: Array = np.where(enough, reached / np.maximum(seen, 1e-6), -np.inf)
        return share

    def learn(self, region: ImageRegion, box: Box) -> None:
        """Update the pass rates by a box where the drogue was found, and by its surroundings."""
        beside = _beside_candidates(box)[::_LEARNED_BESIDE]
        for counts, candidates in ((self._on_counts, _box_candidate(box)), (self._beside_counts, beside)):
            passed, valid = self._evaluate(region, box, candidates, slice(None))
            tried = np.maximum(valid.sum(axis=0), 1)
            evaluated = valid.any(axis=0)
            counts *= np.where(evaluated, _FORGETTING, 1.0)
            counts[0] += np.where(evaluated, (passed & valid).sum(axis=0) / tried, 0)
            counts[1] += np.where(evaluated, (~passed & valid).sum(axis=0) / tried, 0)

    def _divergence(self) -> Array:
        """(N,) symmetric Kullback-Leibler divergence of the pass rates on and beside the drogue."""
        on_drogue, beside = _pass_rate(self._on_counts), _pass_rate(self._beside_counts)
        divergence: Array = (on_drogue - beside) * (np.log(on_drogue / beside) - np.log((1 - on_drogue) / (1 - beside)))
        return divergence

    def _count_passes(self, region: ImageRegion, box: Box, candidates: Array) -> Array:
        """(2, N) how many candidates pass a comparison and how many fail it."""
        passed, valid = self._evaluate(region, box, candidates, slice(None))
        counts: Array = np.stack([(passed & valid).sum(axis=0), (~passed & valid).sum(axis=0)]).astype(np.float64)
        return counts

    def _evaluate(
        self, region: ImageRegion, box: Box, candidates: Array, subset: slice
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(P, N) which comparisons candidates pass, and which of them lie on the image."""
        values, valid = self._pixel_pairs(region, box, candidates, subset)
        return values[0] > values[1] + self._margin, valid

    def _pixel_pairs(
        self, region: ImageRegion, box: Box, candidates: Array, subset: slice = slice(None)
    ) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
        """(2, P, N) both pixels of every comparison, and (P, N) whether both lie in the region."""
        columns, rows, channels = region.size[0], region.size[1], region.pixels.shape[2]
        centers = region.to_grid(candidates[:, :2]).astype(np.float32)
        sides = np.exp(candidates[:, 2:]) * (np.array(box[2:]) / region.step_px)
        points = self._points[:, subset].astype(np.float32)
        x = _round(centers[:, :1] + sides[:, :1].astype(np.float32) * points[:, None, :, 0])
        y = _round(centers[:, 1:] + sides[:, 1:].astype(np.float32) * points[:, None, :, 1])
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        flat = (np.clip(y, 0, rows - 1) * columns + np.clip(x, 0, columns - 1)) * channels
        values = region.pixels.reshape(-1)[flat + self._planes[:, None, subset]].astype(np.int16)
        return values, inside[0] & inside[1]


def _round(points: NDArray[np.float32]) -> NDArray[np.int32]:
    rounded: NDArray[np.int32] = np.floor(points + np.float32(0.5)).astype(np.int32)
    return rounded


def _pass_rate(counts: Array) -> Array:
    """(N,) posterior means of Beta distributions with (2, N) counts of passed and failed."""
    rate: Array = np.clip(counts[0] / counts.sum(axis=0), _SMALLEST_RATE, 1 - _SMALLEST_RATE)
    return rate


def _box_candidate(box: Box) -> Array:
    return np.append(box_center(box), 0.0)[None]


def _on_candidates(box: Box) -> Array:
    """(27, 3) the box with small offsets."""
    offsets = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    candidates: Array = _box_candidate(box) + offsets * (_OFFSET * box[2], _OFFSET * box[3], _LOG_SCALE_OFFSET)
    return candidates


def _beside_candidates(box: Box) -> Array:
    """(28, 3) boxes beside the drogue, which overlap it by less than half or have another size."""
    angles = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angles) * box[2], np.sin(angles) * box[3], np.zeros(8)], axis=1)
    shifted = np.concatenate([distance * ring for distance in _BESIDE_DISTANCES])
    scaled = np.array([(0.0, 0.0, log_scale) for log_scale in _WRONG_LOG_SCALES])
    candidates: Array = _box_candidate(box) + np.concatenate([shifted, scaled])
    return candidates


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
