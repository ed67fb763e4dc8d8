"""Whether places and sizes of a plan's drogues follow the laws that its recipe intends, by chi-square.

Sizes: the distance follows the recipe's law, and the box's side goes with its inverse. Places: the middle of the box is
anywhere in the left image where both views hold all of the drogue, all such places being equally likely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from datasets_manifest.recipe.pose_ranges import DistanceLaw
from datasets_manifest.recipe.recipe import Recipe
from droguekit.batch.planning.recipe_plan import DrawnFrames
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array

SIZE_BINS = 10
PLACE_COLUMNS, PLACE_ROWS = 8, 6
# Cochran's rule: with fewer expected in a cell the statistic does not follow chi-square.
_FEWEST_EXPECTED = 5.0
_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class LawCheck:
    """Counts against a law.

    Attributes:
        counts, expected: by cell; (rows, columns) for places.
        statistic: Pearson's, for draws that need not have equal laws.
        degrees: of freedom; 0 where there are too few draws to say anything.
    """

    counts: Array
    expected: Array
    statistic: float
    degrees: int

    @property
    def p_value(self) -> float:
        """Chance of a statistic as large as this, or larger, if the law holds."""
        return float(chi2.sf(self.statistic, self.degrees)) if self.degrees else 1.0


def check_sizes(drawn: DrawnFrames, recipe: Recipe) -> tuple[LawCheck, Array] | None:
    """Sizes of the boxes in bins of equal ratio, the first and the last open.

    Returns:
        The check, and the (SIZE_BINS + 1,) edges of the bins [px]; None without a drogue, with drogues of several
        sizes, or where distances are not drawn: at stations and in sequences.
    """
    shows, law = np.isfinite(drawn.distances_m), recipe.distance
    if law.law == "stations" or recipe.sequence is not None or not shows.any() or law.low_m == law.high_m:
        return None
    if len({variant.drogue.rim_radius_m for variant in recipe.variants}) > 1:
        return None
    assert law.low_m is not None and law.high_m is not None
    sides_px = drawn.sides_px[shows]
    # The mean of what attitude and lenses make of a drogue's size; it moves draws over an edge both ways alike.
    side_at_1_m = float(np.exp(np.log(sides_px * drawn.distances_m[shows]).mean()))
    edges = np.geomspace(side_at_1_m / law.high_m, side_at_1_m / law.low_m, SIZE_BINS + 1)
    shares = np.diff(1.0 - distance_share(law, side_at_1_m / edges))
    places = np.clip(np.searchsorted(edges, sides_px, side="right") - 1, 0, SIZE_BINS - 1)
    return chi_square(np.eye(SIZE_BINS)[places], np.tile(shares, (len(places), 1))), edges


def distance_share(law: DistanceLaw, distance_m: Array) -> Array:
    """Share of a law's distances that are nearer than given ones; not for stations."""
    assert law.low_m is not None and law.high_m is not None
    low, high = law.low_m, law.high_m
    if law.law == "uniform":
        share = (distance_m - low) / (high - low)
    elif law.law == "log-uniform":
        share = np.log(distance_m / low) / np.log(high / low)
    else:
        share = (1.0 / low - 1.0 / distance_m) / (1.0 / low - 1.0 / high)
    result: Array = np.clip(share, 0.0, 1.0)
    return result


def check_places(drawn: DrawnFrames, camera: PinholeCamera) -> LawCheck | None:
    """Middles of the boxes in equal cells of the left image; None where no place is drawn."""
    free = np.isfinite(drawn.rooms_px).all(axis=1)
    if not free.any():
        return None
    columns = np.linspace(-0.5, camera.width_px - 0.5, PLACE_COLUMNS + 1)
    rows = np.linspace(-0.5, camera.height_px - 0.5, PLACE_ROWS + 1)
    u, v = drawn.centers_px[free].T
    rooms = drawn.rooms_px[free]
    expected = np.einsum("nr,nc->nrc", _shares(rooms[:, 2:], rows), _shares(rooms[:, :2], columns))
    cells = _cell(v, rows) * PLACE_COLUMNS + _cell(u, columns)
    found = chi_square(np.eye(PLACE_ROWS * PLACE_COLUMNS)[cells], expected.reshape(len(cells), -1))
    shape = (PLACE_ROWS, PLACE_COLUMNS)
    return LawCheck(found.counts.reshape(shape), found.expected.reshape(shape), found.statistic, found.degrees)


def _shares(room: Array, edges: Array) -> Array:
    """(N, K) share of each (N, 2) interval in each cell between K + 1 edges."""
    low, high = room[:, :1], np.maximum(room[:, 1:], room[:, :1] + 1e-6)
    overlap = np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1])
    shares: Array = np.maximum(overlap, 0.0) / (high - low)
    return shares


def _cell(value: Array, edges: Array) -> Array:
    return np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)


def chi_square(hits: Array, laws: Array) -> LawCheck:
    """Pearson's test for draws that each have a law of their own.

    With one law for all it is the textbook's sum of (count - expected)^2 / expected. Otherwise counts vary less than
    that sum takes them to, and their own covariance stands in its place. Cells in which few draws are expected count as
    one.

    Args:
        hits: (N, K) 1 in the cell in which a draw fell, 0 elsewhere.
        laws: (N, K) chances of each draw to fall into each cell.
    """
    counts, expected = hits.sum(axis=0), laws.sum(axis=0)
    rare = expected < _FEWEST_EXPECTED
    if rare.any() and not rare.all() and expected[rare].sum() < _FEWEST_EXPECTED:
        # Too few even together: with the smallest of the others.
        rare[np.argmin(np.where(rare, np.inf, expected))] = True
    if rare.any():
        hits = np.column_stack([hits[:, ~rare], hits[:, rare].sum(axis=1)])
        laws = np.column_stack([laws[:, ~rare], laws[:, rare].sum(axis=1)])
    covariance = np.diag(laws.sum(axis=0)) - laws.T @ laws
    excess = hits.sum(axis=0) - laws.sum(axis=0)
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _RANK_TOLERANCE * max(float(values[-1]), 1.0)
    statistic = float((np.square(vectors[:, kept].T @ excess) / values[kept]).sum())
    return LawCheck(counts, expected, statistic, int(kept.sum()))
