"""Finds the markers among the blobs of one image: the largest set onto which one affine map carries the layout.

The image of a flat pattern is an affine map up to perspective, which moves a marker by less than a third of its radius
where the whole drogue is in view. Missing markers, false blobs and the hub (near the middle, where no marker is) need
no special rules. Markers at several depths lean with the drogue's tilt: once most are matched, their
map has one more column, for the depth.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from nav.matching.marker_channel import Blobs
from nav.numerics.compiled import compiled

# Blurring and thresholds change a disc's apparent radius by less than this factor at 5 px of diameter.
_SIZE_FACTOR = 1.6
# Tolerances as a share of a marker's radius: for two-point guesses, which ignore tilt, and for the fitted map.
_GUESS_TOLERANCE = 0.8
_FIT_TOLERANCE = 0.4
# Least singular value of the fit: markers with a smaller one lie on a line.
_ON_A_LINE = 1e-6
# Beyond 70 degrees the markers hide in the basket; guesses from two blobs, which ignore tilt, seldom lead to a ring of
# more than 40.
_STRONGEST_TILT_COSINE = 0.35
_REFINED_GUESSES = 16
_VOTE_DECIMALS = 3
# Four numbers in each row of the map of markers at several depths, and one marker to spare.
_LEAST_FOR_LEAN = 5
FEW = 4  # markers are enough where the ring is predicted or another image shows the same ones
# A disc that touches the picture's edge is dropped, and perspective shifts it by up to a third of its radius.
_REACH = 1.4
# Largest distance of an undetected marker from the map, in multiples of that of the others.
_MOST_OFF = 3.0
# A complete ring this close to its map ends the search.
_GOOD_RMS_FRACTION = 0.1
# Another order of the markers is as good where its distances from the map are at most this many times as large, and
# another one where it moves a marker by more than this many radii.
_AS_GOOD, _ELSEWHERE = 2.0, 1.0
# Ways from a disc's centre to its left, right, upper and lower end, in radii.
_SIDES = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])

ImageMap = Callable[[Array], Array]


@dataclass(frozen=True, eq=False)
class RingMatch:
    """The markers of one image.

    Attributes:
        affine: (2, 3) map from the rim plane [m] to pixels.
        blob_of_marker: (N,) index of each marker's blob, -1 for a missing one; modulo the layout's symmetry.
        rms_fraction: root mean square distance of the blobs from the map, as a share of a marker's radius.
        lean_px_per_m: (2,) how far markers behind the rim plane are moved, per depth; zero where all have one depth.
        is_ambiguous: whether the blobs fit the markers in another order as well, that is no rotation of the layout.
    """

    affine: Array
    blob_of_marker: NDArray[np.int64]
    rms_fraction: float
    lean_px_per_m: Array = field(default_factory=lambda: np.zeros(2))
    is_ambiguous: bool = False

    @property
    def count(self) -> int:
        """Number of markers found."""
        return int((self.blob_of_marker >= 0).sum())

    @property
    def scale_px_per_m(self) -> float:
        """Largest scale of the map: focal length over distance. [px/m]"""
        return _singular_values(self.affine)[0]

    def cut(self, layout: MarkerLayout, size_px: tuple[int, int]) -> NDArray[np.bool_]:
        """(N,) markers whose images certainly reach beyond a picture of (width, height)."""
        # The least extent of a disc, less the error of the map.
        return ~self._inside(layout, size_px, _singular_values(self.affine)[1] * (1 - _MOST_OFF * self.rms_fraction))

    def clear(
        self, layout: MarkerLayout, size_px: tuple[int, int], image_px: ImageMap | None = None
    ) -> NDArray[np.bool_]:
        """(N,) markers whose images certainly lie within a picture of (width, height), see `match_cut_ring`."""
        return self._inside(layout, size_px, _singular_values(self.affine)[0] * _REACH, image_px)

    def _inside(
        self,
        layout: MarkerLayout,
        size_px: tuple[int, int],
        reach_px_per_m: float,
        image_px: ImageMap | None = None,
    ) -> NDArray[np.bool_]:
        """(N,) markers whose centres are further from the picture's edge than their radius times a scale."""
        places_px = _places_px(layout, self.affine, self.lean_px_per_m)
        ends_px = places_px[:, None] + layout.radius_m * reach_px_per_m * _SIDES
        if image_px is not None:
            ends_px = image_px(ends_px)
        inside: NDArray[np.bool_] = ((ends_px > 0) & (ends_px < np.array(size_px) - 1)).all(axis=(1, 2))
        return inside

    def moved(self, shift_px: tuple[float, float]) -> RingMatch:
        """The match with all blobs moved right and down by x and y. [px]"""
        affine = self.affine.copy()
        affine[:, 2] += shift_px
        return replace(self, affine=affine)


def least_markers(layout: MarkerLayout) -> int:
    """Least number of markers that counts as the drogue: 3/5 of them, and at least four where there are four."""
    return min(layout.count, max(4, -(-3 * layout.count // 5)))


@lru_cache(maxsize=16)
def symmetry_permutations(layout: MarkerLayout) -> NDArray[np.int64]:
    """(order, N) for each rotation that maps the layout onto itself: the marker that comes to lie on marker i."""
    turns = np.exp(2j * np.pi * np.arange(layout.symmetry_order) / layout.symmetry_order)
    places = _complex(layout.centers_m[:, :2])
    gaps = np.abs(turns[:, None, None] * places[None, None, :] - places[None, :, None])
    permutations: NDArray[np.int64] = np.argmin(gaps, axis=2)
    permutations.flags.writeable = False
    return permutations


def match_ring(blobs: Blobs, layout: MarkerLayout) -> RingMatch | None:
    """The best consistent set of markers among blobs, or None.

    Args:
        blobs: of one image.
        layout: the drogue's markers.
    """
    return _best_match(blobs, layout, least_markers(layout))


def match_cut_ring(
    blobs: Blobs, layout: MarkerLayout, size_px: tuple[int, int], image_px: ImageMap | None = None
) -> RingMatch | None:
    """At least four markers of a ring whose other markers the picture's edge cuts off, or None.

    These do not count as the drogue unless the other eye shows the same.

    Args:
        blobs: of one image.
        layout: the drogue's markers.
        size_px: width and height of the delivered image.
        image_px: where places among the blobs lie on the delivered image; None where they are places on it.
    """
    match = _best_match(blobs, layout, FEW)
    if match is None or (match.clear(layout, size_px, image_px) & (match.blob_of_marker < 0)).any():
        return None
    return match


def _best_match(blobs: Blobs, layout: MarkerLayout, least: int) -> RingMatch | None:
    """The match with most markers, at least `least`, the best fitting one of equals; None if there is none."""
    if len(blobs) < least:
        return None
    best: RingMatch | None = None
    others: list[RingMatch] = []
    permutations = symmetry_permutations(layout)
    tried: set[bytes] = set()
    for turn, shift in _best_guesses(blobs, layout):
        affine = np.array([[turn.real, -turn.imag, shift.real], [turn.imag, turn.real, shift.imag]])
        blob_of_marker = _nearest_blobs(affine, blobs, layout, _GUESS_TOLERANCE)
        # Most guesses are rotations of one ring: the same blobs in a rotated order give the same map, rotated.
        key = min(blob_of_marker[permutation].tobytes() for permutation in permutations)
        if key in tried:
            continue
        tried.add(key)
        match = _fit(blob_of_marker, blobs, layout, least)
        if match is not None:
            others.append(match)
            best = match if best is None or _rank(match) > _rank(best) else best
        if best is not None and best.count == layout.count and best.rms_fraction < _GOOD_RMS_FRACTION:
            return best
    if best is None or not any(_differ(best, other, layout) for other in others):
        return best
    return replace(best, is_ambiguous=True)


def _differ(best: RingMatch, other: RingMatch, layout: MarkerLayout) -> bool:
    """Whether another match is as good, and puts markers elsewhere in whatever rotation of the layout."""
    rms_fraction = max(best.rms_fraction, _GOOD_RMS_FRACTION)
    if other.count < best.count or other.rms_fraction > _AS_GOOD * rms_fraction:
        return False
    one, two = (_places_px(layout, match.affine, match.lean_px_per_m) for match in (best, other))
    moved_px = np.hypot(*(two[symmetry_permutations(layout)] - one).transpose(2, 0, 1)).max(axis=1).min()
    return bool(moved_px > _ELSEWHERE * layout.radius_m * np.sqrt(_determinant(best.affine)))


def match_ring_near(blobs: Blobs, layout: MarkerLayout, affine: Array, least: int = FEW) -> RingMatch | None:
    """The markers among blobs where the ring is predicted, or None.

    Few markers are enough there; a ring anywhere in the image needs more to be distinguished from other objects.

    Args:
        blobs: of one image.
        layout: the drogue's markers.
        affine: (2, 3) map from the rim plane [m] to pixels, right to some tenths of a marker's radius.
        least: least number of markers, three or more.
    """
    if len(blobs) < least:
        return None
    return _fit(_nearest_blobs(affine, blobs, layout, _GUESS_TOLERANCE), blobs, layout, least)


def _rank(match: RingMatch) -> tuple[int, float]:
    return match.count, -match.rms_fraction


def _complex(points: Array) -> NDArray[np.complex128]:
    result: NDArray[np.complex128] = points[..., 0] + 1j * points[..., 1]
    return result


def _best_guesses(blobs: Blobs, layout: MarkerLayout) -> list[tuple[complex, complex]]:
    """Similarity maps `z -> turn z + shift` that carry the most markers onto blobs, from all pairs of blobs."""
    turns, shifts = _pair_guesses(blobs, layout)
    places_m = np.ascontiguousarray(layout.centers_m[:, :2])
    votes = _count_votes(turns, shifts, places_m, blobs.centers_px, blobs.radii_px, layout.radius_m)
    # Maps that are equal but for rounding stay in the order of their pairs, which mixes the orders of the markers.
    order = np.argsort(-votes.round(_VOTE_DECIMALS), kind="stable")[:_REFINED_GUESSES]
    return [(complex(turns[i]), complex(shifts[i])) for i in order if votes[i] >= 3]


@compiled
def _count_votes(
    turns: NDArray[np.complex128],
    shifts: NDArray[np.complex128],
    places_m: Array,
    centers_px: Array,
    radii_px: Array,
    radius_m: float,
) -> Array:
    """(G,) for each map, how many markers lie near a blob of their size; their mean nearness breaks ties.

    Args:
        turns, shifts: (G,) of the maps, see `_best_guesses`.
        places_m: (N, 2) places of the markers in the rim plane. [m]
        centers_px: (M, 2) centres of the blobs. [px]
        radii_px: (M,) their radii. [px]
        radius_m: of a marker. [m]
    """
    votes = np.zeros(len(turns))
    for guess in range(len(turns)):
        turn, shift = turns[guess], shifts[guess]
        radius_px = radius_m * abs(turn)
        tolerance_px = _GUESS_TOLERANCE * radius_px
        nearness_sum = 0.0
        for marker in range(len(places_m)):
            x_px = turn.real * places_m[marker, 0] - turn.imag * places_m[marker, 1] + shift.real
            y_px = turn.imag * places_m[marker, 0] + turn.real * places_m[marker, 1] + shift.imag
            nearest_px2 = tolerance_px**2
            for blob in range(len(centers_px)):
                size_px = radii_px[blob]
                if size_px < _SIZE_FACTOR * radius_px and radius_px < _SIZE_FACTOR * size_px:
                    gap_px2 = (x_px - centers_px[blob, 0]) ** 2 + (y_px - centers_px[blob, 1]) ** 2
                    nearest_px2 = min(nearest_px2, gap_px2)
            if nearest_px2 < tolerance_px**2:
                votes[guess] += 1.0
                nearness_sum += 1 - np.sqrt(nearest_px2) / tolerance_px
        votes[guess] += nearness_sum / len(places_m) / 2
    return votes


def _pair_guesses(blobs: Blobs, layout: MarkerLayout) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Maps that carry two markers onto two blobs whose sizes agree with their distance."""
    places, image = _complex(layout.centers_m[:, :2]), _complex(blobs.centers_px)
    radii = blobs.radii_px
    size_scale = np.sqrt(radii[:, None] * radii) / layout.radius_m
    alike = (radii[:, None] < _SIZE_FACTOR * radii) & (radii < _SIZE_FACTOR * radii[:, None])
    np.fill_diagonal(alike, False)
    gaps = np.abs(image[:, None] - image)
    turns, shifts = [np.zeros(0, complex)], [np.zeros(0, complex)]
    # One marker of each orbit of the symmetry is enough as the first: the others give the same maps, turned.
    first_markers = np.unique(symmetry_permutations(layout).min(axis=0))
    for i in first_markers:
        arms = np.delete(places, i) - places[i]
        scale = gaps / np.abs(arms)[:, None, None]
        plausible = alike & (scale < _SIZE_FACTOR * size_scale) & (size_scale < _SIZE_FACTOR * scale)
        j, p, q = np.nonzero(plausible)
        turn = (image[q] - image[p]) / arms[j]
        turns.append(turn)
        shifts.append(image[p] - turn * places[i])
    return np.concatenate(turns), np.concatenate(shifts)


def _fit(blob_of_marker: NDArray[np.int64], blobs: Blobs, layout: MarkerLayout, least: int) -> RingMatch | None:
    """Affine map refined from the blobs that a guess matches, or None where they cannot be the drogue."""
    places = np.column_stack([layout.centers_m[:, :2], np.ones(layout.count)])
    lean = np.zeros(2)
    fitted = None
    for tolerance in (_GUESS_TOLERANCE, _GUESS_TOLERANCE, _FIT_TOLERANCE, _FIT_TOLERANCE, None):
        # Mostly the first guess already matches the right blobs, and the same blobs give the same map.
        if fitted is None or (blob_of_marker != fitted).any():
            fitted, hit = blob_of_marker, blob_of_marker >= 0
            # A guess ignores the tilt, which moves far markers of small radius out of its tolerance.
            if hit.sum() < min(least, FEW):
                return None
            seen, centers_px = places[hit], blobs.centers_px[blob_of_marker[hit]]
            solution, _, _, singular = np.linalg.lstsq(seen, centers_px, rcond=None)
            if singular[-1] <= _ON_A_LINE:
                return None
            affine = solution.T
            if not layout.is_flat and hit.sum() >= _LEAST_FOR_LEAN:
                affine, lean = _fit_with_lean(layout.centers_m[hit], centers_px, affine)
        if tolerance is not None:
            blob_of_marker = _nearest_blobs(affine, blobs, layout, tolerance, lean)
    if hit.sum() < least:
        return None
    largest, smallest = _singular_values(affine)
    if _determinant(affine) <= 0 or smallest < _STRONGEST_TILT_COSINE * largest:
        return None
    residual = seen @ affine.T - centers_px
    if lean.any():
        residual = residual + layout.centers_m[hit, 2:] * lean
    rms_px = np.sqrt((residual**2).sum(axis=1).mean())
    radius_px = layout.radius_m * np.sqrt(_determinant(affine))
    return RingMatch(affine, blob_of_marker, float(rms_px / radius_px), lean)


def _fit_with_lean(centers_m: Array, centers_px: Array, affine: Array) -> tuple[Array, Array]:
    """Affine map of the rim plane, and its lean with depth, of markers at several depths; as given if undetermined."""
    design = np.column_stack([centers_m[:, :2], np.ones(len(centers_m)), centers_m[:, 2]])
    solution, _, rank, _ = np.linalg.lstsq(design, centers_px, rcond=_ON_A_LINE)
    return (solution.T[:, :3], solution[3]) if rank == design.shape[1] else (affine, np.zeros(2))


def _places_px(layout: MarkerLayout, affine: Array, lean_px_per_m: Array) -> Array:
    """(N, 2) images of the markers by a map. [px]"""
    places: Array = layout.centers_m[:, :2] @ affine[:, :2].T + affine[:, 2]
    return places if layout.is_flat else places + layout.centers_m[:, 2:] * lean_px_per_m


def _nearest_blobs(
    affine: Array, blobs: Blobs, layout: MarkerLayout, tolerance: float, lean_px_per_m: Array | None = None
) -> NDArray[np.int64]:
    """(N,) the blob nearest to each marker's image, -1 where no blob of similar size lies within the tolerance."""
    places_px = _places_px(layout, affine, np.zeros(2) if lean_px_per_m is None else lean_px_per_m)
    radius_px = layout.radius_m * math.sqrt(abs(_determinant(affine)))
    return _nearest_alike(places_px, radius_px, tolerance * radius_px, blobs.centers_px, blobs.radii_px)


@compiled
def _nearest_alike(
    places_px: Array, radius_px: float, tolerance_px: float, centers_px: Array, radii_px: Array
) -> NDArray[np.int64]:
    """(N,) the nearest of M blobs of similar size to each place, -1 where none lies within the tolerance."""
    nearest = np.full(len(places_px), -1)
    for place in range(len(places_px)):
        least_px = tolerance_px
        for blob in range(len(centers_px)):
            size_px = radii_px[blob]
            if size_px < _SIZE_FACTOR * radius_px and radius_px < _SIZE_FACTOR * size_px:
                x_px, y_px = places_px[place, 0] - centers_px[blob, 0], places_px[place, 1] - centers_px[blob, 1]
                gap_px = np.sqrt(x_px * x_px + y_px * y_px)
                if gap_px < least_px:
                    least_px, nearest[place] = gap_px, blob
    return nearest


def _determinant(affine: Array) -> float:
    return float(affine[0, 0] * affine[1, 1] - affine[0, 1] * affine[1, 0])


def _singular_values(affine: Array) -> tuple[float, float]:
    """Largest and smallest singular value of a map's linear part, in closed form."""
    (a, b), (c, d) = affine[:, :2].tolist()
    even, odd = math.hypot(a + d, b - c) / 2, math.hypot(a - d, b + c) / 2
    return even + odd, abs(even - odd)
