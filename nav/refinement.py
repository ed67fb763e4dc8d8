"""Refines matched markers by the edge model, and measures the hub where their pose predicts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.images import StereoImages
from drogue_models.marker_layout import MarkerLayout
from geometry.circles import disc_image_centers, disc_outline, project_disc_centers
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, StereoRig
from nav.centroids.annuli import AnnulusFits, fit_annuli
from nav.centroids.binary_centroids import smallest_gap_m
from nav.centroids.centroid_uncertainty import NoiseModel
from nav.centroids.disc_fit import fit_discs
from nav.centroids.discs import LARGEST_SCALE, DiscFits, unfitted_discs
from nav.centroids.ellipses import Ellipses, outline_shapes, shape_radii
from nav.centroids.face_background import VISIBLE_MARGIN_PX, FaceBackground
from nav.centroids.marker_signal import MarkerSignal, marker_signals
from nav.centroids.motion_blur import ImageMotion
from nav.centroids.outline_pixels import WHOLE_RADIUS_PX
from nav.centroids.small_discs import EDGELESS_RADIUS_PX, LARGEST_SMALL_RADIUS_PX, fit_small_discs
from nav.lens_correction import distort_points, undistort_points
from nav.matching.marker_channel import PLAIN, balancing_weight
from nav.numerics.medians import median
from nav.pose.joint import joint
from nav.pose.monocular import mono_lm
from nav.pose.pose_method import HUB_EDGES, INNER_EDGE, OUTER_EDGE, NoFixReason, Observation, Solution

_OUTLINE_POINTS = 24
# The hub is also searched by a second pose that is this likely and predicts it this far from the first one's.
_LEAST_WEIGHT = 0.01
_LEAST_STEP_PX = 0.5
# With fewer fitted markers, which a pose needs with one to spare, all markers stay as they were.
_LEAST_MARKERS = 4
# The edge model takes all light beside a disc as the background's: that of neighbours as close as this enters a window.
_CLOSE_PX = 3.0
# Standard deviation of a centre up to which it is a measurement without a fit. [px]
_LARGEST_SIGMA_PX = 0.2
# Mean square of the residuals of such centres over what they state; a sky beside a narrow face moves them by more.
_LARGEST_SCATTER, _POSE_PARAMETERS = 6.0, 6
# No part of the edge of smaller markers is clear of the rim's, so the other colours get the weight that removes that.
_BALANCED_BELOW_PX = 8.0


def rough_pose(observation: Observation) -> Solution | NoFixReason:
    """The pose of matched markers without the hub, from both eyes or from the only one that shows markers."""
    return joint(observation) if observation.seen.any(axis=1).all() else mono_lm(observation)


def refine(
    images: StereoImages, color: int | None, observation: Observation, rough: Solution, others_weight: float = PLAIN
) -> Observation | NoFixReason:
    """Measure the same markers by the edge model, or small ones by their blurred picture; and the hub if it is visible.

    Args:
        images: the pair.
        color: see `nav.matching.marker_channel.marker_color`.
        observation: matched markers, right to about half a pixel.
        rough: their pose, see `rough_pose`.
        others_weight: see `nav.matching.marker_channel.marker_channel`.

    Returns:
        Edge-fitted markers, without those that the fit rejects (clipped, cut, shadowed, occluded). Where too few fit,
        the observation as given, or the reason where small ones are not placed well enough without a fit. Hub edges are
        measured where the pose of the fitted markers predicts them.
    """
    layout = observation.layout
    radius_px = _radius_px(observation.rig, layout, rough.left_from_drogue)
    discs = _initial_discs(observation, rough)
    face = _face_background(layout, np.nonzero(observation.seen)[1], radius_px / layout.radius_m)
    gap_px = (smallest_gap_m(layout) / layout.radius_m - 2) * radius_px
    if radius_px < EDGELESS_RADIUS_PX or (radius_px <= LARGEST_SMALL_RADIUS_PX and gap_px < _CLOSE_PX):
        return _refine_small(images, observation, rough, radius_px)
    is_narrow = face is not None and face.margin_px <= VISIBLE_MARGIN_PX
    if is_narrow and color is not None and images.left.ndim == 3 and radius_px < _BALANCED_BELOW_PX:
        others_weight = _balanced_weight(images, color, observation, rough, others_weight)
    signals = marker_signals(images, color, _concatenate([discs, *_likely_hubs(observation, rough)]), others_weight)
    # Of clipped discs this small hardly any edge is left: size and spread of their light must be known to fit them.
    is_edgeless = radius_px <= LARGEST_SMALL_RADIUS_PX and _are_mostly_clipped(signals, discs)
    fits = unfitted_discs(discs) if is_edgeless else fit_discs(signals, discs, face)
    if fits.noise is None or _left_in_each_eye(observation, fits).min() < min(_LEAST_MARKERS, layout.count):
        if radius_px > LARGEST_SMALL_RADIUS_PX:
            return observation
        small = _refine_small(images, observation, rough, radius_px)
        return observation if isinstance(small, NoFixReason) and _are_placed(observation, rough) else small
    refined = _with_markers(observation, fits)
    return refined if layout.hub_center_m is None else _with_hub(refined, signals, fits.noise, fits.motion)


def _are_placed(observation: Observation, rough: Solution) -> bool:
    """Whether markers are known well enough without a fit.

    Peaks of light, which any light beside moves, are not, nor are centres that miss their pose by more than they state.
    """
    variances = np.einsum("enii->en", observation.cov_px2)[observation.seen] / 2
    freedom = max(2 * int(observation.seen.sum()) - _POSE_PARAMETERS, 1)
    scatter = 2 * rough.modes[0].cost / freedom
    return bool(median(variances) < _LARGEST_SIGMA_PX**2 and scatter < _LARGEST_SCATTER)


def _are_mostly_clipped(signals: tuple[MarkerSignal, MarkerSignal], discs: Ellipses) -> bool:
    """Whether the middles of most discs are clipped."""
    clipped = []
    for eye, signal in enumerate(signals):
        places = np.rint((discs.centers_px[discs.eyes == eye] - signal.first_px) / signal.pitch_px).astype(np.int64)
        columns, rows = np.clip(places, 0, np.array(signal.clipped.shape[::-1]) - 1).T
        clipped.append(signal.clipped[rows, columns])
    return bool(np.concatenate(clipped).mean() > 0.5)


def _refine_small(
    images: StereoImages, observation: Observation, rough: Solution, radius_px: float
) -> Observation | NoFixReason:
    """Measure small markers by their blurred picture; the reason where an eye has too few that can be fitted.

    Markers that were not found are fitted too, where the pose predicts them, as their light reaches their neighbours;
    they are not measurements.
    """
    whole = _with_predicted_markers(observation, rough)
    face = _face_background(observation.layout, np.nonzero(whole.seen)[1], radius_px / observation.layout.radius_m)
    fits = fit_small_discs(images, _initial_discs(whole, rough), face)
    fits = fits.take(np.flatnonzero(observation.seen[whole.seen]))
    eyes = np.nonzero(observation.seen)[0]
    for eye in np.unique(eyes):
        mine = eyes == eye
        left = int(fits.accepted[mine].sum())
        if left < min(_LEAST_MARKERS, observation.layout.count):
            reasons = Counter(reason for reason, own in zip(fits.reasons, mine, strict=True) if own and reason)
            told = f"{left} of {int(mine.sum())} small markers of the {EYES[eye]} image can be fitted"
            return NoFixReason(f"{told}; most others: {reasons.most_common(1)[0][0]}")
    return _with_markers(observation, fits)


def _with_predicted_markers(observation: Observation, rough: Solution) -> Observation:
    """The observation with the markers that were not found where a pose predicts them, in eyes that show any."""
    layout, pixels = observation.layout, observation.pixels_px.copy()
    radii_m = np.full(layout.count, layout.radius_m)
    for side, eye in enumerate(EYES):
        missing = ~observation.seen[side]
        if missing.any() and not missing.all():
            centers = project_disc_centers(observation.rig, rough.left_from_drogue, layout.centers_m, radii_m, eye)
            pixels[side, missing] = centers[missing]
    return replace(observation, pixels_px=pixels)


def _radius_px(rig: StereoRig, layout: MarkerLayout, pose: RigidTransform) -> float:
    """Radius of a marker's image near the axis of the delivered images. [px]"""
    return rig.delivered_focal_px * layout.radius_m / float(pose.translation_m[2])


def _initial_discs(observation: Observation, rough: Solution) -> Ellipses:
    """Outlines of the observed markers in the delivered images, by their places and their rough pose."""
    rig, layout = observation.rig, observation.layout
    eyes, index = np.nonzero(observation.seen)
    ideal_px_per_m = np.array([rig.camera.fx_px, rig.camera.fy_px]) / rough.left_from_drogue.translation_m[2]
    sizes = np.broadcast_to(np.diag(layout.radius_m * ideal_px_per_m), (layout.count, 2, 2))
    seen = zip(EYES, observation.pixels_px, observation.cov_px2, strict=True)
    centers_px = np.stack([distort_points(rig, eye, places, sizes, cov)[0] for eye, places, cov in seen])
    return Ellipses(eyes, centers_px[eyes, index], marker_shapes(rig, layout, rough.left_from_drogue)[eyes, index])


def _likely_hubs(observation: Observation, rough: Solution) -> list[Ellipses]:
    """The hub's edges as each of the likely rough poses predicts them."""
    likely = [rough.modes[0], *(mode for mode in rough.modes[1:] if mode.weight >= _LEAST_WEIGHT)]
    rig, layout = observation.rig, observation.layout
    return [hub for mode in likely for hub in _hub_edges(rig, layout, mode.left_from_drogue)]


def _balanced_weight(
    images: StereoImages, color: int, observation: Observation, rough: Solution, others_weight: float
) -> float:
    """Weight of the other colours at which the rim casts no step of light, see `balancing_weight`."""
    rig, layout, translation_m = observation.rig, observation.layout, rough.left_from_drogue.translation_m
    radius_px = _radius_px(rig, layout, rough.left_from_drogue)
    middles_px = np.stack([rig.image(translation_m, eye) for eye in EYES])
    # An eye that shows no markers has no say: far outside of the image there is nothing to weigh.
    middles_px[~observation.seen.any(axis=1)] = -1e6
    rim_px = radius_px * layout.face_outer_radius_m / layout.radius_m
    return balancing_weight(images, color, middles_px, rim_px, others_weight)


def _left_in_each_eye(observation: Observation, fits: DiscFits) -> NDArray[np.int64]:
    """Numbers of accepted markers in the eyes that showed any."""
    eyes = np.nonzero(observation.seen)[0]
    counts = np.bincount(eyes[fits.accepted], minlength=len(EYES))
    left: NDArray[np.int64] = counts[observation.seen.any(axis=1)]
    return left


def _with_markers(observation: Observation, fits: DiscFits) -> Observation:
    """The observation with the accepted fits as its markers, in the ideal images."""
    good = fits.accepted
    eyes, index = (each[good] for each in np.nonzero(observation.seen))
    pixels, cov = np.full_like(observation.pixels_px, np.nan), np.full_like(observation.cov_px2, np.nan)
    shapes = np.full_like(cov, np.nan)
    pixels[eyes, index], cov[eyes, index] = fits.ellipses.centers_px[good], fits.cov_px2[good]
    shapes[eyes, index] = fits.ellipses.shapes_px[good]
    for side, eye in enumerate(EYES):
        pixels[side], cov[side] = undistort_points(observation.rig, eye, pixels[side], shapes[side], cov[side])
    return replace(observation, pixels_px=pixels, cov_px2=cov)


def _face_background(layout: MarkerLayout, index: NDArray[np.int64], scale_px_per_m: float) -> FaceBackground | None:
    """The face around the markers; None for a drogue without one."""
    places_m = layout.centers_m[:, :2]
    edges_m = layout.face_inner_radius_m, layout.face_outer_radius_m
    if edges_m[1] == 0:
        return None
    out_m = np.hypot(places_m[:, 0], places_m[:, 1])
    margin_m = min((edges_m[1] - out_m).min(), (out_m - edges_m[0]).min()) - layout.radius_m
    return FaceBackground(places_m[index], edges_m, float(margin_m * scale_px_per_m))


def marker_shapes(rig: StereoRig, layout: MarkerLayout, pose: RigidTransform) -> Array:
    """(2, N, 2, 2) shapes of the markers' images: equal circles behind the lens, or for large ones their own ellipses.

    At 1.7 m the near side of a tilted drogue is larger by pixels. A circle's window would end within the blur of the
    edge there, and leave no face to fit its light to.
    """
    depth_m = pose.translation_m[2]
    radius_px = _radius_px(rig, layout, pose)
    even = np.broadcast_to(_middle_shapes(rig, layout, pose, radius_px)[:, None], (len(EYES), layout.count, 2, 2))
    if radius_px <= WHOLE_RADIUS_PX:
        return even
    outlines_m = disc_outline(pose, layout.centers_m, layout.radius_m, _OUTLINE_POINTS).reshape(-1, 3)
    # A wrong rough pose may place part of the drogue beside or behind the eyes.
    if outlines_m[:, 2].min() < depth_m / 2:
        return even
    points = np.stack([rig.image(outlines_m, eye) for eye in EYES]).reshape(-1, _OUTLINE_POINTS, 2)
    shapes = outline_shapes(points - points.mean(axis=1, keepdims=True))
    scale = shape_radii(shapes) / radius_px
    likely = ((scale > 1 / LARGEST_SCALE) & (scale < LARGEST_SCALE)).reshape(even.shape[:2])
    return np.where(likely[..., None, None], shapes.reshape(even.shape), even)


def _middle_shapes(rig: StereoRig, layout: MarkerLayout, pose: RigidTransform, radius_px: float) -> Array:
    """(2, 2, 2) shapes in which the eyes show a marker that faces them in the drogue's middle."""
    circle = np.broadcast_to(radius_px * np.eye(2), (len(EYES), 2, 2))
    if rig.lenses is None and rig.camera.fx_px == rig.camera.fy_px:
        return circle
    facing = RigidTransform(np.eye(3), pose.translation_m)
    outline_m = disc_outline(facing, np.zeros(3), layout.radius_m, _OUTLINE_POINTS)
    points = np.stack([rig.image(outline_m, eye) for eye in EYES])
    shapes = outline_shapes(points - points.mean(axis=1, keepdims=True))
    scale = shape_radii(shapes) / radius_px
    # Outlines beyond a lens's field shrink to its edge.
    return np.where(((scale > 1 / LARGEST_SCALE) & (scale < LARGEST_SCALE))[:, None, None], shapes, circle)


def _hub_edges(rig: StereoRig, layout: MarkerLayout, pose: RigidTransform) -> list[Ellipses]:
    """The hub's inner and outer edge in both eyes by a pose; empty without a hub or with the hub behind the eyes."""
    if layout.hub_center_m is None or pose.apply(layout.hub_center_m)[2] <= 0:
        return []
    radii_m = layout.hub_inner_radius_m, layout.hub_outer_radius_m
    outlines = disc_outline(pose, np.stack([layout.hub_center_m] * HUB_EDGES), radii_m, _OUTLINE_POINTS)
    points = np.stack([rig.image(outlines, eye) for eye in EYES], axis=1)
    shapes = outline_shapes((points - points.mean(axis=2, keepdims=True)).reshape(-1, _OUTLINE_POINTS, 2))
    places = np.stack([layout.hub_center_m] * HUB_EDGES), np.array(radii_m)
    centers = np.stack([disc_image_centers(rig, pose, *places, eye) for eye in EYES], axis=1)
    return [
        Ellipses(np.arange(len(EYES)), centers[edge], shapes.reshape(HUB_EDGES, len(EYES), 2, 2)[edge])
        for edge in (INNER_EDGE, OUTER_EDGE)
    ]


def _concatenate(groups: list[Ellipses]) -> Ellipses:
    return Ellipses(
        np.concatenate([group.eyes for group in groups]),
        np.concatenate([group.centers_px for group in groups]),
        np.concatenate([group.shapes_px for group in groups]),
    )


def _with_hub(
    observation: Observation,
    signals: tuple[MarkerSignal, MarkerSignal],
    noise: NoiseModel,
    motion: ImageMotion | None,
) -> Observation:
    """The observation with the hub's outer edge, searched by the markers' pose and by its mirrored mode."""
    solution = joint(observation)
    if isinstance(solution, NoFixReason):
        return observation
    collar_factor = observation.layout.collar_radius_m / observation.layout.hub_outer_radius_m
    found: list[tuple[AnnulusFits, Array]] = []
    for edges in _hub_candidates(observation, solution):
        outer, inner = edges[OUTER_EDGE], edges[INNER_EDGE]
        found.append((fit_annuli(signals, outer, inner, noise, collar_factor, motion), outer.shapes_px))
        if found[-1][0].certain:
            break
    best = max(found, key=lambda each: each[0].evidence_per_px2, default=None)
    if best is None or not best[0].accepted.any():
        return observation
    fits, shapes_px = best
    pixels = np.full((len(EYES), HUB_EDGES, 2), np.nan)
    cov = np.full((len(EYES), HUB_EDGES, 2, 2), np.nan)
    pixels[fits.accepted, OUTER_EDGE] = fits.centers_px[fits.accepted]
    cov[fits.accepted, OUTER_EDGE] = fits.cov_px2[fits.accepted]
    shapes = np.stack([shapes_px] * HUB_EDGES, axis=1)
    for side, eye in enumerate(EYES):
        pixels[side], cov[side] = undistort_points(observation.rig, eye, pixels[side], shapes[side], cov[side])
    return replace(observation, hub_px=pixels, hub_cov_px2=cov)


def _hub_candidates(observation: Observation, solution: Solution) -> Iterator[list[Ellipses]]:
    """The hub's edges by each likely mode, the likeliest first, without those that predict a place again.

    The light on a hub is uneven: a fit that starts beside it may end on part of it, or on something else.
    """
    tried: list[Array] = []
    for mode in solution.modes:
        edges = _hub_edges(observation.rig, observation.layout, mode.left_from_drogue)
        if not edges or (tried and mode.weight < _LEAST_WEIGHT):
            continue
        centers_px = edges[OUTER_EDGE].centers_px
        if all(np.abs(centers_px - other).max() >= _LEAST_STEP_PX for other in tried):
            tried.append(centers_px)
            yield edges
