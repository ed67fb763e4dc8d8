"""Pose methods on triangulated markers: closed forms, and the seed paper's three-sphere pose.

The closed forms are `constant`, `mean-plane`, `disparity-plane` and `circle-fit`. `circle-fit` is a reconstruction of
what the literature on spatial circle fitting is known for (Xie and Wang 2011, binocular; Wang et al. 2020), whose full
texts were not available.

The paper's are `paper` and `paper-literal`. Every three triangulated markers give a candidate for the drogue's origin.
`paper` takes the candidate whose reprojection into both eyes fits all markers best, the reading of the paper that
works; the attitude is that of the plane through all markers. `paper-literal` takes the printed score instead: eq. 13
compares the rows of one reprojected point in both eyes. In a rectified rig these are equal for every point, so the
printed score is zero for every candidate and selects none; a step in depth (eq. 16) would not move anything either.

Source: the seed paper, section 3.3, eqs. 1-13; docs/explanation/paper.md lists what is corrected, and why eqs. 14-16
are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Literal
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from drogue_models.marker_layout import MarkerLayout
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES
from nav.pose.marker_geometry import (
    align_roll,
    paired_mask,
    plane_normal,
    points_in_eyes,
    project_markers,
    rotations_from_axes,
    triangulate_markers,
)
from nav.pose.pose_method import NoFixReason, Observation, PoseMethod, Solution, stereo_fault

# Any three points lie on a circle, whatever their error.
_LEAST_FOR_CIRCLE = 4
_REFINEMENTS = 10
NOT_FLAT = NoFixReason("this method fits a plane, and the drogue's markers lie at several depths")


def constant(observation: Observation) -> Solution | NoFixReason:
    """Method `constant`: position from the mean of the triangulated markers, pitch and yaw zero."""
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    index, points = triangulate_markers(observation)
    pose = pose_from_axis(points, observation.layout.centers_m[index], np.array([0.0, 0.0, 1.0]))
    return Solution(pose, paired_mask(observation))


def mean_plane(observation: Observation) -> Solution | NoFixReason:
    """Method `mean-plane`: position from the mean of the triangulated markers, attitude from their plane."""
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    if not observation.layout.is_flat:
        return NOT_FLAT
    index, points = triangulate_markers(observation)
    pose = pose_from_axis(points, observation.layout.centers_m[index], plane_normal(points))
    return Solution(pose, paired_mask(observation))


def disparity_plane(observation: Observation) -> Solution | NoFixReason:
    """Method `disparity-plane`: a plane fitted to the disparities, whose noise is uniform.

    On a plane, disparities are linear in the rays' slopes, and the coefficients are its normal up to scale. The markers
    are the intersections of their rays with the plane; the position is that of their mean.
    """
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    if not observation.layout.is_flat:
        return NOT_FLAT
    rig, paired = observation.rig, observation.paired
    left, right = observation.pixels_px[:, paired]
    rays = rig.camera.rays(np.column_stack([left[:, 0], (left[:, 1] + right[:, 1]) / 2]))
    coefficients = np.linalg.lstsq(rays, left[:, 0] - right[:, 0], rcond=None)[0]
    disparity_px = rays @ coefficients
    if not (disparity_px.min() > 0 and coefficients[2] > 0):
        return NoFixReason("the plane through the disparities passes behind the cameras")
    points = rays * (rig.camera.fx_px * rig.baseline_m / disparity_px)[:, None]
    axis = coefficients / np.linalg.norm(coefficients)
    return Solution(pose_from_axis(points, observation.layout.centers_m[paired], axis), paired_mask(observation))


def pose_from_axis(points_m: Array, centers_m: Array, axis: Array) -> RigidTransform:
    """Pose with a given axis that maps the mean of (K, 3) markers to the mean of (K, 3) points.

    The roll aligns the markers with the points. With missing markers the means differ from the drogue's origin.
    """
    mean_m = points_m.mean(axis=0)
    unrolled = rotations_from_axes(axis[None])
    rotation = align_roll(unrolled, points_m, mean_m[None], centers_m - centers_m.mean(axis=0))[0]
    return RigidTransform(rotation, mean_m - rotation @ centers_m.mean(axis=0))


def circle_fit(observation: Observation) -> Solution | NoFixReason:
    """Method `circle-fit`: total-least-squares plane of the triangulated markers, and a circle of free radius in it."""
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    if observation.layout.ring_radius_m is None:
        return NoFixReason("a circle fit needs all markers on one circle about the drogue's origin")
    index, points = triangulate_markers(observation)
    if len(index) < _LEAST_FOR_CIRCLE:
        return NoFixReason(f"{len(index)} markers in both eyes, a circle fit needs {_LEAST_FOR_CIRCLE}")
    unrolled = rotations_from_axes(plane_normal(points)[None])
    mean = points.mean(axis=0)
    center = fit_circle_center((points - mean) @ unrolled[0, :, :2])
    if center is None:
        return NoFixReason("the triangulated markers lie on no circle")
    origin = mean + unrolled[0, :, :2] @ center
    if origin[2] <= 0:
        return NoFixReason("the circle's centre lies behind the cameras")
    rotation = align_roll(unrolled, points, origin[None], observation.layout.centers_m[index])[0]
    return Solution(RigidTransform(rotation, origin), paired_mask(observation))


def fit_circle_center(points_m: Array) -> Array | None:
    """(2,) centre of the circle through (K, 2) points, or None where they lie on a line.

    Kasa's algebraic circle, refined by Gauss-Newton on the distances; the refinement is used if it fits better.
    """
    design = np.column_stack([2 * points_m, np.ones(len(points_m))])
    squares = (points_m**2).sum(axis=1)
    solution, _, rank, _ = np.linalg.lstsq(design, squares, rcond=None)
    if rank < 3:
        return None
    initial: Array = solution[:2]
    center: Array = initial.copy()
    for _ in range(_REFINEMENTS):
        offsets = points_m - center
        distance = np.linalg.norm(offsets, axis=1)
        if not distance.min() > 0:
            break
        direction = offsets / distance[:, None]
        # The best radius is the mean distance, which is eliminated from residuals and derivatives.
        slopes = direction - direction.mean(axis=0)
        center = center + np.linalg.lstsq(slopes, distance - distance.mean(), rcond=None)[0]
    refined = np.isfinite(center).all() and _distance_deviation(points_m, center) <= _distance_deviation(
        points_m, initial
    )
    return center if refined else initial


def _distance_deviation(points_m: Array, center: Array) -> float:
    return float(np.linalg.norm(points_m - center, axis=1).std())


# What the score of a candidate compares:
#   literal         rows of the candidate's one reprojected point in both eyes;
#   own_vdiff       measured rows in both eyes of the candidate's three markers;
#   center_per_eye  the candidate with the rim's centre in each image, from a homography;
#   full_reproj     all markers in both eyes, by Huber's loss; the selection of method `paper`.
RowReading = Literal["literal", "own_vdiff", "center_per_eye", "full_reproj"]

# Threshold of the Huber loss: twice the centroids' standard deviation, and no less than a good centroid's error.
_HUBER_SIGMAS = 2.0
_LEAST_HUBER_PX = 0.05
_DEPTH_STEPS = 5
# No step changes the distance by more than this share of it.
_LARGEST_DEPTH_STEP = 0.3
# Four points determine a homography.
_LEAST_FOR_HOMOGRAPHY = 4
# A candidate's rows differ by the rounding of float64 pixels, which must not decide between equal scores. [px^2]
_SAME_SCORE_PX2 = 1e-18


@dataclass(frozen=True, eq=False)
class TripleCircles:
    """Circles through three points each.

    Attributes:
        centers_m: (T, 3) circumcentres.
        normals: (T, 3) unit normals with positive z.
        radii2_m2: (T,) squared circumradii.
        members: (T, 3) indices of the points.
    """

    centers_m: Array
    normals: Array
    radii2_m2: Array
    members: NDArray[np.int64]


def triple_circles(points_m: Array) -> TripleCircles:
    """Circles through all C(K, 3) triples of (K, 3) points; nan for three points on a line."""
    triples = np.array(list(combinations(range(len(points_m)), 3)))
    p, a, b = (points_m[triples[:, column]] for column in range(3))
    a, b = a - p, b - p
    across = np.cross(a, b)
    across2 = (across**2).sum(axis=1, keepdims=True)
    across2 = np.where(across2 > 0, across2, np.nan)
    a2, b2 = (a**2).sum(axis=1, keepdims=True), (b**2).sum(axis=1, keepdims=True)
    offset = (np.cross(across, a) * b2 + np.cross(b, across) * a2) / (2 * across2)
    normals = across / np.sqrt(across2)
    normals = np.where(normals[:, 2:] < 0, -normals, normals)
    return TripleCircles(p + offset, normals, (offset**2).sum(axis=1), triples)


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """Poses from the three-sphere construction.

    Attributes:
        points_m: (K, 3) triangulated markers.
        layout: of the same K markers.
        pixels_px: (2, K, 2) their measured centres.
        origins_m: (T, 3) far intersections of the spheres about three markers each.
        rotations: (T, 3, 3) attitudes of the planes through those markers.
        members: (T, 3) indices of those markers among the K.
    """

    points_m: Array
    layout: MarkerLayout
    pixels_px: Array
    origins_m: Array
    rotations: Array
    members: NDArray[np.int64]

    def pose_at(self, origin_m: Array) -> RigidTransform:
        """Pose with a given origin, and the attitude of the plane through all markers."""
        unrolled = rotations_from_axes(plane_normal(self.points_m)[None])
        rotation = align_roll(unrolled, self.points_m, origin_m[None], self.layout.centers_m)[0]
        return RigidTransform(rotation, origin_m)


def three_sphere_candidates(observation: Observation) -> PoseCandidates | NoFixReason:
    """All candidates in front of the cameras; at least one."""
    ring_radius_m = observation.layout.ring_radius_m
    if ring_radius_m is None:
        return NoFixReason("the paper's method needs all markers on one circle about the drogue's origin")
    index, points = triangulate_markers(observation)
    layout = MarkerLayout(observation.layout.centers_m[index], observation.layout.radius_m, None)
    circles = triple_circles(points)
    # The spheres about three markers meet twice on the circle's axis; with noise the discriminant may be negative.
    discriminant = ring_radius_m**2 - circles.radii2_m2
    origins = circles.centers_m + circles.normals * np.sqrt(np.maximum(discriminant, 0))[:, None]
    sound = np.isfinite(origins).all(axis=1) & (origins[:, 2] > ring_radius_m)
    if not sound.any():
        return NoFixReason("no three markers give a place in front of the cameras")
    origins, axes = origins[sound], circles.normals[sound]
    rotations = align_roll(rotations_from_axes(axes), points, origins, layout.centers_m)
    pixels = observation.pixels_px[:, index]
    return PoseCandidates(points, layout, pixels, origins, rotations, circles.members[sound])


def huber_threshold_px(observation: Observation) -> float:
    """Threshold of Huber's loss in the paper's visual reprojection. [px]"""
    return max(_HUBER_SIGMAS * observation.sigma_px, _LEAST_HUBER_PX)


def reprojection_scores(observation: Observation, candidates: PoseCandidates) -> Array:
    """(T,) Huber losses of all markers in both eyes; infinite for a candidate that cannot be projected. [px^2]"""
    huber_px = huber_threshold_px(observation)
    # In a nearly edge-on candidate a marker may lie behind a camera: its prediction is infinite or nan, and never best.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        predicted = project_markers(observation.rig, candidates.layout, candidates.rotations, candidates.origins_m)
        residuals = np.linalg.norm(predicted - candidates.pixels_px, axis=-1)
        scores: Array = np.where(np.isfinite(residuals), _huber_loss(residuals, huber_px), np.inf).sum(axis=(1, 2))
    return scores


def paper(observation: Observation) -> Solution | NoFixReason:
    """Method `paper`: three-sphere construction and visual reprojection."""
    return _solve_three_spheres(observation, step_in_depth=False)


def paper_with_step(observation: Observation) -> Solution | NoFixReason:
    """As `paper`, with the position then refined along its line of sight; for comparison."""
    return _solve_three_spheres(observation, step_in_depth=True)


def _solve_three_spheres(observation: Observation, step_in_depth: bool) -> Solution | NoFixReason:
    reason = stereo_fault(observation)
    if reason is not None:
        return reason
    candidates = three_sphere_candidates(observation)
    if isinstance(candidates, NoFixReason):
        return candidates
    best = int(np.argmin(reprojection_scores(observation, candidates)))
    origin = candidates.origins_m[best]
    if step_in_depth:
        start = RigidTransform(candidates.rotations[best], origin)
        huber_px = huber_threshold_px(observation)
        origin = _refine_depth(observation, candidates.layout, candidates.pixels_px, huber_px, start)
        if not (np.isfinite(origin).all() and origin[2] > 0):
            return NoFixReason("the step in depth left the space in front of the cameras")
    return Solution(candidates.pose_at(origin), paired_mask(observation))


def _huber_loss(residuals_px: Array, threshold_px: float) -> Array:
    """Huber's loss of residual norms. [px^2]"""
    return np.where(residuals_px <= threshold_px, residuals_px**2 / 2, threshold_px * (residuals_px - threshold_px / 2))


def _refine_depth(
    observation: Observation, layout: MarkerLayout, pixels_px: Array, huber_px: float, start: RigidTransform
) -> Array:
    """(3,) origin, refined along its line of sight by Huber-weighted Gauss-Newton steps (the paper's 14-16). [m]"""
    camera, rotation = observation.rig.camera, start.rotation[None]
    origin = start.translation_m.copy()
    for _ in range(_DEPTH_STEPS):
        residuals = project_markers(observation.rig, layout, rotation, origin[None])[0] - pixels_px
        points = points_in_eyes(observation.rig, layout.centers_m, rotation, origin[None])[0]
        direction = origin / origin[2]
        slope_x = camera.fx_px / points[..., 2] * (direction[0] - points[..., 0] / points[..., 2])
        slope_y = camera.fy_px / points[..., 2] * (direction[1] - points[..., 1] / points[..., 2])
        slopes = np.stack([slope_x, slope_y], axis=-1)
        weights = np.minimum(1.0, huber_px / np.maximum(np.linalg.norm(residuals, axis=-1), huber_px))[..., None]
        step = -(weights * slopes * residuals).sum() / (weights * slopes**2).sum()
        limit = _LARGEST_DEPTH_STEP * origin[2]
        origin = origin + direction * float(np.clip(step, -limit, limit))
    return origin


def paper_reading(e_v: RowReading) -> PoseMethod:
    """The paper's method with one reading of its score.

    Args:
        e_v: what the score compares.

    Raises:
        ValueError: there is no such reading.
    """
    if e_v not in _SCORES:
        raise ValueError(f"e_v: must be one of {', '.join(_SCORES)}, got {e_v!r}")
    score = _SCORES[e_v]

    def method(observation: Observation) -> Solution | NoFixReason:
        reason = stereo_fault(observation)
        if reason is not None:
            return reason
        candidates = three_sphere_candidates(observation)
        if isinstance(candidates, NoFixReason):
            return candidates
        scores = score(observation, candidates)
        if isinstance(scores, NoFixReason):
            return scores
        equal = np.flatnonzero(scores <= scores.min() + _SAME_SCORE_PX2)
        # Ties are broken at random, seeded by the measurements so that results are reproducible.
        rng = np.random.default_rng(crc32(candidates.pixels_px.tobytes()))
        chosen = int(rng.choice(equal))
        return Solution(candidates.pose_at(candidates.origins_m[chosen]), paired_mask(observation))

    return method


def paper_literal(observation: Observation) -> Solution | NoFixReason:
    """Method `paper-literal`: three-sphere construction and the score of eq. 13 as printed."""
    return paper_reading("literal")(observation)


def _row_differences(observation: Observation, candidates: PoseCandidates) -> Array:
    left, right = (observation.rig.project(candidates.origins_m, eye)[:, 1] for eye in EYES)
    scores: Array = (left - right) ** 2 / 2
    return scores


def _measured_row_differences(observation: Observation, candidates: PoseCandidates) -> Array:
    rows = candidates.pixels_px[0, :, 1] - candidates.pixels_px[1, :, 1]
    scores: Array = (rows[candidates.members] ** 2).sum(axis=1)
    return scores


def _center_distances(observation: Observation, candidates: PoseCandidates) -> Array | NoFixReason:
    if len(candidates.points_m) < _LEAST_FOR_HOMOGRAPHY:
        return NoFixReason(f"the rim's centre in one image needs {_LEAST_FOR_HOMOGRAPHY} markers in both eyes")
    scores = np.zeros(len(candidates.origins_m))
    for eye, pixels in zip(EYES, candidates.pixels_px, strict=True):
        center = _homography_center(candidates.layout.centers_m[:, :2], pixels)
        if center is None:
            return NoFixReason(f"the markers of the {eye} eye show no centre")
        scores += ((observation.rig.project(candidates.origins_m, eye) - center) ** 2).sum(axis=1)
    return scores


def _homography_center(places_m: Array, pixels_px: Array) -> Array | None:
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


_SCORES: dict[str, Callable[[Observation, PoseCandidates], Array | NoFixReason]] = {
    "literal": _row_differences,
    "own_vdiff": _measured_row_differences,
    "center_per_eye": _center_distances,
    "full_reproj": reprojection_scores,
}
