"""Comparisons of two pixels, each with learned pass rates (Bernoulli probabilities) on the drogue and beside it.

Inspired by the title of Rasol et al., "N-fold Bernoulli probability based adaptive fast-tracking algorithm and its
application to autonomous aerial refueling", doi:10.1016/j.cja.2022.07.014, whose text was not available; no
re-implementation. Binary tests of pixel pairs: Calonder et al., doi:10.1007/978-3-642-15561-1_56.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.tracking.region import Box, ImageRegion, box_center

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
