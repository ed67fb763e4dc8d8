"""Comparisons of two pixels, each a coin whose chances on the drogue and beside it are learned.

Inspired by the title of Rasol et al., "N-fold Bernoulli probability based adaptive fast-tracking algorithm and its
application to autonomous aerial refueling", doi:10.1016/j.cja.2022.07.014, whose text was not available; no
re-implementation. Binary tests of pixel pairs: Calonder et al., doi:10.1007/978-3-642-15561-1_56.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geometry.se3 import Array
from nav.tracking.region import Box, ImageRegion, box_center

# Points lie in the disc about the box's middle of this radius, in box sides: the rim and a little of what is beyond.
_REACH = 0.58
_DRAWN_PER_KEPT = 4
# A test is passed where one pixel exceeds the other by this share of the drogue's own contrast, and by so many levels:
# an even sky passes none as long as its noise stays below that.
_MARGIN_FRACTION = 0.12
_LEAST_MARGIN = 3
# How old answers count beside new ones.
_FORGETTING = 0.98
# A test is never taken for certain.
_LEAST_CHANCE = 0.03
# Misplacements that still count as on the drogue, in box sides and as a log-scale ...
_JITTER, _SCALE_JITTER = 1 / 32, 0.04
# ... and those that count as beside it: eight middles around, at each of these distances in box sides, and the box's
# own middle with each of these log-scales.
_BESIDE = (0.45, 0.8, 1.3)
_WRONG_LOG_SCALES = (-0.5, -0.3, 0.3, 0.5)
# One of so many of these is learned from in each image, for they change little. It has no factor in common with the
# eight directions, so that all of them are.
_LEARNED_BESIDE = 3
# So much of what all tests tell must be on the image.
_LEAST_SEEN = 0.4


class PairTests:
    """N tests of one drogue in one eye.

    Attributes:
        count: N.
    """

    def __init__(self, region: ImageRegion, box: Box, count: int, rng: np.random.Generator) -> None:
        """Draw tests, and keep those that tell the box's content best from what is around.

        Args:
            region: the box and at least its own size around, where the image has it.
            box: the drogue's. [px]
            count: tests to keep.
            rng: of the draw.
        """
        drawn = count * _DRAWN_PER_KEPT
        angle, radius = rng.uniform(0, 2 * np.pi, (2, drawn)), _REACH * np.sqrt(rng.uniform(0, 1, (2, drawn)))
        self._places = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
        self._planes = rng.integers(0, region.pixels.shape[2], (2, drawn))
        middle = _at_box(box)
        self._margin = _LEAST_MARGIN
        values, _ = self._values(region, box, middle)
        self._margin = max(_LEAST_MARGIN, int(_MARGIN_FRACTION * np.ptp(np.percentile(values, (5, 95)))))
        # Each pair in the order in which the drogue passes it.
        turned = values[0, 0] < values[1, 0]
        self._places[:, turned] = self._places[::-1, turned]
        self._planes[:, turned] = self._planes[::-1, turned]
        on, beside = _on_candidates(box), _beside_candidates(box)
        self._on = 1 + self._passes(region, box, on)
        self._beside = 1 + self._passes(region, box, beside)
        kept = np.argsort(-self._worth(), kind="stable")[:count]
        self._places, self._planes = self._places[:, kept], self._planes[:, kept]
        self._on, self._beside = self._on[:, kept], self._beside[:, kept]
        self.count = count

    def scores(self, region: ImageRegion, box: Box, candidates: Array, most: int | None = None) -> Array:
        """Log-likelihood ratio of drogue against surroundings, as a share of what the drogue is expected to reach.

        Args:
            region: where to look.
            box: of which the candidates are copies. [px]
            candidates: (P, 3) middles [px] and log-scales against the box.
            most: use only so many tests, the best first; all by default.

        Returns:
            (P,) 1 on the drogue, on average; minus infinity where too little of a candidate is on the image.
        """
        subset = slice(0, self.count if most is None else most)
        passed, valid = self._passed(region, box, candidates, subset)
        on, beside = _chance(self._on[:, subset]), _chance(self._beside[:, subset])
        gain, loss = np.log(on / beside).astype(np.float32), np.log((1 - on) / (1 - beside)).astype(np.float32)
        expected = (on * gain + (1 - on) * loss).astype(np.float32)
        # Products of truth values have no fast way of their own.
        valid32 = valid.astype(np.float32)
        reached = (passed & valid).astype(np.float32) @ (gain - loss) + valid32 @ loss
        seen = valid32 @ expected
        enough = seen >= _LEAST_SEEN * expected.sum()
        share: Array = np.where(enough, reached / np.maximum(seen, 1e-6), -np.inf)
        return share

    def learn(self, region: ImageRegion, box: Box) -> None:
        """Let the answers in a box where the drogue was found, and around it, count."""
        beside = _beside_candidates(box)[::_LEARNED_BESIDE]
        for counts, candidates in ((self._on, _at_box(box)), (self._beside, beside)):
            passed, valid = self._passed(region, box, candidates, slice(None))
            tried = np.maximum(valid.sum(axis=0), 1)
            looked = valid.any(axis=0)
            counts *= np.where(looked, _FORGETTING, 1.0)
            counts[0] += np.where(looked, (passed & valid).sum(axis=0) / tried, 0)
            counts[1] += np.where(looked, (~passed & valid).sum(axis=0) / tried, 0)

    def _worth(self) -> Array:
        """(N,) what an answer tells on average: the divergence of both chances, each way."""
        on, beside = _chance(self._on), _chance(self._beside)
        worth: Array = (on - beside) * (np.log(on / beside) - np.log((1 - on) / (1 - beside)))
        return worth

    def _passes(self, region: ImageRegion, box: Box, candidates: Array) -> Array:
        """(2, N) how many candidates pass a test and how many fail."""
        passed, valid = self._passed(region, box, candidates, slice(None))
        counts: Array = np.stack([(passed & valid).sum(axis=0), (~passed & valid).sum(axis=0)]).astype(np.float64)
        return counts

    def _passed(
        self, region: ImageRegion, box: Box, candidates: Array, subset: slice
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(P, N) which tests candidates pass, and which of them lie on the image."""
        values, valid = self._values(region, box, candidates, subset)
        return values[0] > values[1] + self._margin, valid

    def _values(
        self, region: ImageRegion, box: Box, candidates: Array, subset: slice = slice(None)
    ) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
        """(2, P, N) both pixels of every test, and (P, N) whether both lie in the region."""
        columns, rows, channels = region.size[0], region.size[1], region.pixels.shape[2]
        middles = region.grid(candidates[:, :2]).astype(np.float32)
        sides = np.exp(candidates[:, 2:]) * (np.array(box[2:]) / region.step_px)
        places = self._places[:, subset].astype(np.float32)
        x = _rounded(middles[:, :1] + sides[:, :1].astype(np.float32) * places[:, None, :, 0])
        y = _rounded(middles[:, 1:] + sides[:, 1:].astype(np.float32) * places[:, None, :, 1])
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        flat = (np.clip(y, 0, rows - 1) * columns + np.clip(x, 0, columns - 1)) * channels
        values = region.pixels.reshape(-1)[flat + self._planes[:, None, subset]].astype(np.int16)
        return values, inside[0] & inside[1]


def _rounded(places: NDArray[np.float32]) -> NDArray[np.int32]:
    rounded: NDArray[np.int32] = np.floor(places + np.float32(0.5)).astype(np.int32)
    return rounded


def _chance(counts: Array) -> Array:
    """(N,) posterior means of Beta distributions with (2, N) counts of passed and failed."""
    chance: Array = np.clip(counts[0] / counts.sum(axis=0), _LEAST_CHANCE, 1 - _LEAST_CHANCE)
    return chance


def _at_box(box: Box) -> Array:
    return np.append(box_center(box), 0.0)[None]


def _on_candidates(box: Box) -> Array:
    """(27, 3) the box, a little misplaced."""
    offsets = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 3)
    candidates: Array = _at_box(box) + offsets * (_JITTER * box[2], _JITTER * box[3], _SCALE_JITTER)
    return candidates


def _beside_candidates(box: Box) -> Array:
    """(28, 3) boxes that are not the drogue's, and overlap it by less than half or have another size."""
    angles = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angles) * box[2], np.sin(angles) * box[3], np.zeros(8)], axis=1)
    shifted = np.concatenate([distance * ring for distance in _BESIDE])
    scaled = np.array([(0.0, 0.0, log_scale) for log_scale in _WRONG_LOG_SCALES])
    candidates: Array = _at_box(box) + np.concatenate([shifted, scaled])
    return candidates
