"""Assigns the regions of both images to the drogue's markers.

First the drogue's ring is found among the regions of each image (`nav.matching.ring_matching`). That orders the markers
up to the layout's symmetry, with gaps for missing ones. An image with too few markers for a ring of its own is searched
where the other image's ring predicts it. Where the image's edge cuts the ring, the remaining part is enough if both
images show it. Then every rotation of the right image's order against the left's is tried, and the one with the
smallest epipolar and disparity cost is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array
from geometry.stereo import EYES, Eye, StereoRig
from nav.centroids.binary_centroids import BinaryCentroids
from nav.matching.ring_matching import (
    FEW,
    RingMatch,
    least_markers,
    match_cut_ring,
    match_ring,
    match_ring_near,
    symmetry_permutations,
)
from nav.pose.pose_method import NoFixReason, Observation

# The best rotation must fit the pairs within this share of the gap between neighbours; a wrong one is off by a gap.
_LARGEST_COST_FRACTION = 0.35
# Where both images show a part of the ring only, the pairs must fit better. Drawn ones, tilted by up to 20 degrees,
# have 0.033 of the gap at most.
_LARGEST_COST_FRACTION_OF_PARTS = 0.05
# Markers in the other image of four that the image's edge leaves: six coordinates, and the row and size of each.
_FEWEST_BESIDE_A_CUT_RING = 3
# A pair whose rows differ by more than this is not one marker: room for the rig's calibration, and six deviations.
_ROW_TOLERANCE_PX = 1.0
_ROW_TOLERANCE_SIGMA = 6.0
# A marker cut by something before it has lost a third of its area before its centre is a fifth of a radius off.
_AREA_FACTOR = 1.5


@dataclass(frozen=True, eq=False)
class _EyeMarkers:
    """Markers of one eye in the layout's order; NaN where one was not found."""

    centers_px: Array
    cov_px2: Array

    def reordered(self, permutation: NDArray[np.int64]) -> _EyeMarkers:
        """The same markers in the order of a layout rotated onto itself."""
        return _EyeMarkers(self.centers_px[permutation], self.cov_px2[permutation])


def correspond(
    left: BinaryCentroids, right: BinaryCentroids, rig: StereoRig, layout: MarkerLayout
) -> Observation | NoFixReason:
    """Match regions of both eyes with each other and with the drogue's markers.

    The roll that the layout's symmetry leaves open is the one nearest to zero.

    Args:
        left: regions found in the left image.
        right: regions found in the right image.
        rig: the stereo rig.
        layout: the drogue's markers.

    Returns:
        The observation for the pose methods, with NaN for an eye that shows no ring; or the reason why neither eye
        shows one.
    """
    rings = _match_rings(left, right, rig, layout)
    permutations = symmetry_permutations(layout)
    if rings[0] is None and rings[1] is None:
        return NoFixReason(f"{explain_no_match(left, 'left')}, and {explain_no_match(right, 'right')}")
    if rings[0] is None or rings[1] is None:
        eye, ring, centroids = (1, rings[1], right) if rings[0] is None else (0, rings[0], left)
        assert ring is not None
        only = _markers(centroids, ring).reordered(permutations[_rotation_nearest_to_zero(ring, layout)])
        return Observation(rig, layout, *_one_eye_arrays(only, eye))
    upright = permutations[_rotation_nearest_to_zero(rings[0], layout)]
    first = _markers(left, rings[0]).reordered(upright)
    second = _markers(right, rings[1])
    disparity_px = rig.baseline_m * rings[0].scale_px_per_m
    costs = _costs_px(first.centers_px, second.centers_px[permutations], disparity_px)
    best = int(np.argmin(costs))
    gap_px = _smallest_gap_m(layout) * rings[0].scale_px_per_m
    is_part = max(rings[0].count, rings[1].count) < least_markers(layout)
    if costs[best] > (_LARGEST_COST_FRACTION_OF_PARTS if is_part else _LARGEST_COST_FRACTION) * gap_px:
        return NoFixReason(f"the rings of both images do not belong together: they differ by {costs[best]:.1f} px")
    return Observation(rig, layout, *_without_bad_pairs(first, second.reordered(permutations[best])))


def _match_rings(
    left: BinaryCentroids, right: BinaryCentroids, rig: StereoRig, layout: MarkerLayout
) -> list[RingMatch | None]:
    """The ring in each image; where only one image shows it by itself, the other is searched where it must be."""
    rings = [centroids.ring or match_ring(centroids.blobs, layout) for centroids in (left, right)]
    if rings[0] is None and rings[1] is None:
        return _match_cut_rings(left, right, rig, layout)
    return _match_missing_eye(rings, (left, right), rig, layout, FEW)


def _match_cut_rings(
    left: BinaryCentroids, right: BinaryCentroids, rig: StereoRig, layout: MarkerLayout
) -> list[RingMatch | None]:
    """The part of the ring that the images' edges leave, in both images or in none."""
    size_px = rig.camera.width_px, rig.camera.height_px
    parts = [match_cut_ring(centroids.blobs, layout, size_px) for centroids in (left, right)]
    parts = _match_missing_eye(parts, (left, right), rig, layout, _FEWEST_BESIDE_A_CUT_RING)
    return [None, None] if parts[0] is None or parts[1] is None else parts


def _match_missing_eye(
    rings: list[RingMatch | None],
    seen: tuple[BinaryCentroids, BinaryCentroids],
    rig: StereoRig,
    layout: MarkerLayout,
    least: int,
) -> list[RingMatch | None]:
    """The rings, completed where only one image shows one by at least this many markers where it predicts them."""
    found = list(rings)
    for eye, toward_px in ((0, 1.0), (1, -1.0)):
        other = rings[1 - eye]
        if rings[eye] is None and other is not None:
            disparity_px = rig.baseline_m * other.scale_px_per_m
            expected = other.moved((toward_px * disparity_px, 0.0)).affine
            found[eye] = match_ring_near(seen[eye].blobs, layout, expected, least)
    return found


def explain_no_match(centroids: BinaryCentroids, eye: Eye) -> str:
    """The reason why an eye has no markers."""
    return f"no ring of markers among {len(centroids.blobs)} regions of the {eye} image"


def _one_eye_arrays(only: _EyeMarkers, eye: int) -> tuple[Array, Array]:
    """Centres (2, N, 2) and covariances (2, N, 2, 2) with one eye's markers and NaN for the other eye."""
    pixels = np.full((len(EYES), *only.centers_px.shape), np.nan)
    covariances = np.full((len(EYES), *only.cov_px2.shape), np.nan)
    pixels[eye], covariances[eye] = only.centers_px, only.cov_px2
    return pixels, covariances


def _markers(centroids: BinaryCentroids, ring: RingMatch) -> _EyeMarkers:
    """The ring's regions in the layout's order, without those whose area is an outlier."""
    found = ring.blob_of_marker >= 0
    blob = ring.blob_of_marker[found]
    areas = centroids.blobs.areas_px2[blob]
    whole = np.abs(np.log(areas / np.median(areas))) < np.log(_AREA_FACTOR)
    found[found] = whole
    centers = np.full((len(found), 2), np.nan)
    covariances = np.full((len(found), 2, 2), np.nan)
    centers[found], covariances[found] = centroids.blobs.centers_px[blob[whole]], centroids.cov_px2[blob[whole]]
    return _EyeMarkers(centers, covariances)


def _rotation_nearest_to_zero(ring: RingMatch, layout: MarkerLayout) -> int:
    """Index of the layout's rotation that brings the ring's roll nearest to zero."""
    linear = ring.affine[:, :2]
    roll = np.arctan2(linear[1, 0] - linear[0, 1], linear[0, 0] + linear[1, 1])
    order = layout.symmetry_order
    # Renumbering the markers by a rotation of 2 pi k / order subtracts that much from the roll.
    return int(np.round(roll * order / (2 * np.pi))) % order


def _costs_px(left_px: Array, right_px: Array, disparity_px: float) -> Array:
    """(T,) root mean squares of row differences, and of disparities against the ring's size, infinite without pairs.

    Args:
        left_px: (N, 2) markers.
        right_px: (T, N, 2) the same in every turn.
        disparity_px: by the ring's size.
    """
    squares = (left_px - right_px - (disparity_px, 0.0)) ** 2
    both = np.isfinite(squares)
    count = both.sum(axis=(1, 2))
    costs: Array = np.sqrt(np.where(both, squares, 0.0).sum(axis=(1, 2)) / np.maximum(count, 1))
    return np.where(count > 0, costs, np.inf)


def _smallest_gap_m(layout: MarkerLayout) -> float:
    squares = ((layout.centers_m[:, None] - layout.centers_m) ** 2).sum(axis=2)
    return float(np.sqrt(squares[np.triu_indices(layout.count, 1)].min()))


def _without_bad_pairs(left: _EyeMarkers, right: _EyeMarkers) -> tuple[Array, Array]:
    """Centres (2, N, 2) and covariances (2, N, 2, 2), NaN for pairs whose row difference is an outlier."""
    rows_px = left.centers_px[:, 1] - right.centers_px[:, 1]
    both = np.isfinite(rows_px)
    sigma_px = np.sqrt(left.cov_px2[:, 1, 1] + right.cov_px2[:, 1, 1])
    bad = np.zeros_like(both)
    off_px = np.abs(rows_px[both] - np.median(rows_px[both]))
    bad[both] = off_px > _ROW_TOLERANCE_PX + _ROW_TOLERANCE_SIGMA * sigma_px[both]
    pixels = np.stack([left.centers_px, right.centers_px])
    covariances = np.stack([left.cov_px2, right.cov_px2])
    pixels[:, bad], covariances[:, bad] = np.nan, np.nan
    return pixels, covariances
