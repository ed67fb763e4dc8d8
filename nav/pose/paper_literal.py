"""Method `paper-literal`: the seed paper's selection as printed, and other readings of it for comparison.

Eq. 13 compares the rows of one reprojected point in both eyes. In a rectified rig they are equal for every point, so
the printed score is zero for every candidate and chooses none; a step in depth (eq. 16) would then move nothing either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal
from zlib import crc32

import numpy as np

from geometry.se3 import Array
from geometry.stereo import EYES
from nav.pose.faults import fault
from nav.pose.paper import Candidates, reprojection_scores, three_sphere_candidates
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod, Solution
from nav.pose.prediction import used_pairs

# What the score of a candidate compares:
#   literal         rows of the candidate's one reprojected point in both eyes;
#   own_vdiff       measured rows in both eyes of the candidate's three markers;
#   center_per_eye  the candidate with the rim's centre that each image shows by itself, from a homography;
#   full_reproj     all markers in both eyes, by Huber's loss; the selection of method `paper`.
RowReading = Literal["literal", "own_vdiff", "center_per_eye", "full_reproj"]

# Four points fix a homography.
_LEAST_FOR_HOMOGRAPHY = 4
# A candidate's rows differ by the rounding of float64 pixels; equal scores must not be told apart by it. [px^2]
_SAME_SCORE_PX2 = 1e-18


def paper_reading(e_v: RowReading) -> PoseMethod:
    """The paper's method with a reading of its score.

    Args:
        e_v: what the score compares.

    Raises:
        ValueError: there is no such reading.
    """
    if e_v not in _SCORES:
        raise ValueError(f"e_v: must be one of {', '.join(_SCORES)}, got {e_v!r}")
    score = _SCORES[e_v]

    def method(observation: Observation) -> Solution | NoFixReason:
        reason = fault(observation)
        if reason is not None:
            return reason
        candidates = three_sphere_candidates(observation)
        if isinstance(candidates, NoFixReason):
            return candidates
        scores = score(observation, candidates)
        if isinstance(scores, NoFixReason):
            return scores
        equal = np.flatnonzero(scores <= scores.min() + _SAME_SCORE_PX2)
        # Where the score does not choose, chance does, keyed by the measurements so that it always does the same.
        rng = np.random.default_rng(crc32(candidates.pixels_px.tobytes()))
        chosen = int(rng.choice(equal))
        return Solution(candidates.pose_at(candidates.origins_m[chosen]), used_pairs(observation))

    return method


def paper_literal(observation: Observation) -> Solution | NoFixReason:
    """Pose by the three-sphere construction and the score of eq. 13 as printed."""
    return paper_reading("literal")(observation)


def _row_difference(observation: Observation, candidates: Candidates) -> Array:
    left, right = (observation.rig.project(candidates.origins_m, eye)[:, 1] for eye in EYES)
    scores: Array = (left - right) ** 2 / 2
    return scores


def _own_rows(observation: Observation, candidates: Candidates) -> Array:
    rows = candidates.pixels_px[0, :, 1] - candidates.pixels_px[1, :, 1]
    scores: Array = (rows[candidates.members] ** 2).sum(axis=1)
    return scores


def _center_per_eye(observation: Observation, candidates: Candidates) -> Array | NoFixReason:
    if len(candidates.points_m) < _LEAST_FOR_HOMOGRAPHY:
        return NoFixReason(f"the rim's centre in one image needs {_LEAST_FOR_HOMOGRAPHY} markers in both eyes")
    scores = np.zeros(len(candidates.origins_m))
    for eye, pixels in zip(EYES, candidates.pixels_px, strict=True):
        center = _projective_center(candidates.layout.centers_m[:, :2], pixels)
        if center is None:
            return NoFixReason(f"the markers of the {eye} eye show no centre")
        scores += ((observation.rig.project(candidates.origins_m, eye) - center) ** 2).sum(axis=1)
    return scores


def _projective_center(places_m: Array, pixels_px: Array) -> Array | None:
    """(2,) image of the origin under the homography that carries (K, 2) places to (K, 2) pixels. [px]"""
    mean = pixels_px.mean(axis=0)
    size = np.sqrt(((pixels_px - mean) ** 2).mean())
    u, v = ((pixels_px - mean) / size).T
    x, y = (places_m / np.sqrt((places_m**2).mean())).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows = [
        np.column_stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u]),
        np.column_stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v]),
    ]
    h = np.linalg.svd(np.vstack(rows))[2][8]
    if abs(h[8]) <= np.finfo(np.float64).eps:
        return None
    center: Array = np.array([h[2], h[5]]) / h[8] * size + mean
    return center


_SCORES: dict[str, Callable[[Observation, Candidates], Array | NoFixReason]] = {
    "literal": _row_difference,
    "own_vdiff": _own_rows,
    "center_per_eye": _center_per_eye,
    "full_reproj": reprojection_scores,
}
