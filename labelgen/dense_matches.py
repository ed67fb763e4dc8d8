"""Where every pixel's point lies in the other eye, or in the same eye's next picture, from depth, part ids and poses.

Each pixel centre's depth gives a point, and its part id the body that carries it, whose poses the frames hold. What the
frames do not determine is left out: the motion of ground, cloud and patchy mist past a camera that travels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.meshes import HOSE_SECTIONS, hose_mesh
from drogue_models.parts import DROGUE_PARTS, FIRST_MARKER_ID, INSTANCE_STEP, Part
from geometry.se3 import Array, RigidTransform
from geometry.stereo import Eye, StereoRig
from scenes.ground.terrain import highest_sine

# Trees and houses are lower.
_GROUND_COVER_M = 30.0
# Two poses that move a point by less than this move it alike. [m]
_SAME_MOTION_M = 1e-9
# Steepest slope of a surface that the test for hidden points follows.
_LEAST_COSINE = 0.1
_HOSE_STEPS, _HOSE_BLOCK = 4, 4096


@dataclass(frozen=True, eq=False)
class SurfacePasses:
    """Passes of one eye through its pixel centres, as in a dataset's EXR files.

    Attributes:
        part_id: (H, W), `drogue_models.parts`.
        depth_m: (H, W) planar depth, infinite where only the background is seen. [m]
        normal: (H, W, 3) unit normal in the eye's frame, 0 for the background.
    """

    part_id: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    normal: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PixelMatches:
    """Where the points that one image shows lie in another image.

    Attributes:
        displacement_px: (H, W, 2) right and down, nan where the frames do not determine it. [px]
        hidden: (H, W) whether something nearer covers the point at the nearest pixel centre of the other image.
        outside: (H, W) whether the point leaves the other image.
    """

    displacement_px: Array
    hidden: NDArray[np.bool_]
    outside: NDArray[np.bool_]

    @property
    def known(self) -> NDArray[np.bool_]:
        """(H, W) whether the displacement is determined."""
        finite: NDArray[np.bool_] = np.isfinite(self.displacement_px[..., 0])
        return finite

    @property
    def matched(self) -> NDArray[np.bool_]:
        """(H, W) whether the other image shows the point."""
        return self.known & ~self.hidden & ~self.outside


def stereo_matches(rig: StereoRig, eye: Eye, seen: SurfacePasses, other: SurfacePasses) -> PixelMatches:
    """Where the points of one eye's picture lie in the other eye's.

    The background counts as infinitely far, as renderers draw it.

    Args:
        rig: both eyes.
        eye: whose pixels are matched.
        seen: passes of that eye.
        other: passes of the other eye.
    """
    far = ~np.isfinite(seen.depth_m)
    points = _points(rig, eye, seen, far)
    target: Eye = "right" if eye == "left" else "left"
    points[~far] += rig.eye_offset_m(eye) - rig.eye_offset_m(target)
    return _matches(rig, target, points, far, other)


def flow_matches(
    before: FrameSpec, after: FrameSpec, eye: Eye, seen: SurfacePasses, later: SurfacePasses
) -> PixelMatches:
    """Where the points of one picture lie in the same eye's next one: optical flow forwards.

    Args:
        before, after: the two frames, of one sequence.
        eye: which eye.
        seen: its passes in `before`.
        later: its passes in `after`.
    """
    rig, far = before.rig, ~np.isfinite(seen.depth_m)
    points = _points(rig, eye, seen, far)
    offset_m = rig.eye_offset_m(eye)
    for part in np.unique(seen.part_id[~far]).tolist():
        here = ~far & (seen.part_id == part)
        points[here] = _moved(before, after, part, points[here] + offset_m) - offset_m
    directions = before.world_from_left.rotate(points[far])
    moved = after.world_from_left.inverse().rotate(directions)
    moved[~_stands_still(before, after, directions)] = np.nan
    points[far] = moved
    return _matches(rig, eye, points, far, later)


def _points(rig: StereoRig, eye: Eye, seen: SurfacePasses, far: NDArray[np.bool_]) -> Array:
    """(H, W, 3) points in the eye's frame; for the background their directions."""
    height, width = seen.depth_m.shape
    rays = rig.rays(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1), eye)
    points: Array = rays * np.where(far, 1.0, seen.depth_m)[..., None]
    return points


def _matches(rig: StereoRig, eye: Eye, points: Array, far: NDArray[np.bool_], other: SurfacePasses) -> PixelMatches:
    """Matches of (H, W, 3) points, or directions where they are far, that are given in the frame of the eye."""
    height, width = far.shape
    points = np.where((points[..., 2] > 0)[..., None], points, np.nan)
    ideal = rig.camera.project(points)
    known = np.isfinite(ideal[..., 0]) & rig.is_in_field(ideal, eye)
    target = np.full_like(ideal, np.nan)
    target[known] = rig.real_px(ideal[known], eye)
    inside = known & rig.camera.contains(np.where(known[..., None], target, -1.0))
    hidden = np.zeros_like(far)
    depth_m = np.where(far, np.inf, points[..., 2])
    hidden[inside] = _is_hidden(rig, eye, target[inside], depth_m[inside], other)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    return PixelMatches(displacement_px=target - pixels, hidden=hidden, outside=known & ~inside)


def _is_hidden(rig: StereoRig, eye: Eye, target_px: Array, depth_m: Array, other: SurfacePasses) -> NDArray[np.bool_]:
    """(N,) whether the nearest pixel centre sees something nearer than a point, by more than a pixel of its surface.

    Args:
        rig, eye: the other image.
        target_px: (N, 2) where the points lie on it. [px]
        depth_m: (N,) their planar depth there, infinite for the background. [m]
        other: its passes.
    """
    center = np.clip(np.rint(target_px), 0, np.array(other.depth_m.shape[::-1]) - 1)
    column, row = center.astype(int).T
    there_m, normal = other.depth_m[row, column].astype(np.float64), other.normal[row, column].astype(np.float64)
    shown = np.isfinite(there_m)
    there_m = np.where(shown, there_m, 1.0)
    to_center, to_target = rig.rays(center, eye), rig.rays(target_px, eye)
    # The surface goes on along its tangent plane.
    facing = (normal * to_target).sum(axis=-1)
    cosine = np.maximum(np.abs(facing) / np.linalg.norm(to_target, axis=-1), _LEAST_COSINE)
    steep = np.abs(facing) < _LEAST_COSINE
    along = (normal * to_center).sum(axis=-1) / np.where(steep, 1.0, facing)
    surface_m = there_m * np.where(steep, 1.0, along)
    tolerance_m = there_m / rig.camera.fx_px / cosine
    hidden: NDArray[np.bool_] = shown & (depth_m > surface_m + tolerance_m)
    return hidden


def _moved(before: FrameSpec, after: FrameSpec, part: int, points_m: Array) -> Array:
    """(N, 3) where points of a part are in the later frame, nan where the frames do not say; in the left camera."""
    unknown = np.full_like(points_m, np.nan)
    if part == Part.HOSE:
        return _moved_hose(before, after, points_m)
    motions = _motions(before, after, part)
    if not motions or any(motion is None for motion in motions):
        return unknown
    places = [motion.apply(points_m) for motion in motions if motion is not None]
    # Two bodies of one part, such as the parts of the receiver, are told apart only by moving alike.
    if any(np.abs(place - places[0]).max(initial=0.0) > _SAME_MOTION_M for place in places):
        return unknown
    return places[0]


def _motions(before: FrameSpec, after: FrameSpec, part: int) -> list[RigidTransform | None]:
    """`after_left_from_before_left` of each body that has this part id; None for one that is not in both frames."""
    if part >= INSTANCE_STEP:
        return []
    if part in DROGUE_PARTS or part >= FIRST_MARKER_ID:
        return [_between(before.left_from_drogue, after.left_from_drogue, before.drogue == after.drogue)]
    if part == Part.TANKER:
        return [_between(before.left_from_tanker, after.left_from_tanker, before.tanker == after.tanker)]
    if part == Part.BOARD:
        boards = before.board, after.board
        if boards[0] is None or boards[1] is None:
            return []
        return [
            _between(boards[0].left_from_board, boards[1].left_from_board, boards[0].shape == boards[1].shape),
        ]
    kind = Part(part).name.lower()
    old, new = ([one for one in frame.bystanders if one.kind == kind] for frame in (before, after))
    if len(old) != len(new):
        return []
    return [
        _between(one.left_from_object, other.left_from_object, one.shape == other.shape)
        for one, other in zip(old, new, strict=True)
    ]


def _between(before: RigidTransform | None, after: RigidTransform | None, is_same: bool) -> RigidTransform | None:
    if before is None or after is None or not is_same:
        return None
    return after @ before.inverse()


def _stands_still(before: FrameSpec, after: FrameSpec, directions: Array) -> NDArray[np.bool_]:
    """(N,) whether the background in (N, 3) world directions looks the same from both places of the camera."""
    old, new = before.environment, after.environment
    if old.map is not None or old.camera_offset_m == new.camera_offset_m:
        return np.ones(len(directions), dtype=np.bool_)
    if old.clouds or (old.mist is not None and old.mist.patchiness > 0):
        return np.zeros(len(directions), dtype=np.bool_)
    highest = max(highest_sine(old.ground, old.altitude_m, _GROUND_COVER_M), 0.0)
    sky: NDArray[np.bool_] = directions[:, 2] > highest * np.linalg.norm(directions, axis=-1)
    return sky


def _moved_hose(before: FrameSpec, after: FrameSpec, points_m: Array) -> Array:
    """The same for the hose: a point keeps its place along it and around it while it bends."""
    grids = []
    for frame in (before, after):
        if frame.drogue is None or frame.left_from_drogue is None or frame.hose_nodes_left_m is None:
            return np.full_like(points_m, np.nan)
        # Engines build the hose in the drogue's axes, which decide how the mesh is turned about its centre line.
        nodes_m = frame.left_from_drogue.inverse().apply(frame.hose_nodes_left_m)
        vertices = frame.left_from_drogue.apply(hose_mesh(nodes_m, frame.drogue.hose_radius_m).vertices[:-2])
        rings = vertices.reshape(-1, HOSE_SECTIONS, 3)
        quarter = HOSE_SECTIONS // 4
        sides = (rings[:, 0] - rings[:, 2 * quarter]) / 2, (rings[:, quarter] - rings[:, 3 * quarter]) / 2
        grids.append(np.stack([rings.mean(axis=1), *sides]))
    old, new = grids
    if old.shape != new.shape:
        return np.full_like(points_m, np.nan)
    blocks = [
        _carried_by_hose(old, new, points_m[first : first + _HOSE_BLOCK])
        for first in range(0, len(points_m), _HOSE_BLOCK)
    ]
    return np.concatenate(blocks)


def _carried_by_hose(old: Array, new: Array, points_m: Array) -> Array:
    """(N, 3) points carried from one bent hose to the other.

    Args:
        old, new: (3, R, 3) of the rings along the hose: centres, and two radii across each other. [m]
        points_m: (N, 3) on the old hose. [m]
    """
    chord = np.diff(old[0], axis=0)
    reach = points_m[:, None] - old[0, :-1]
    share = np.clip((reach * chord).sum(axis=-1) / (chord**2).sum(axis=-1), 0.0, 1.0)
    segment = ((reach - share[..., None] * chord) ** 2).sum(axis=-1).argmin(axis=1)
    at = share[np.arange(len(points_m)), segment]
    low, step = old[:, segment], old[:, segment + 1] - old[:, segment]
    for _ in range(_HOSE_STEPS):
        # The cross-section through the point: linear between two rings, like the mesh.
        center, side, up = low + at[:, None] * step
        across = np.cross(side, up)
        at += ((points_m - center) * across).sum(axis=-1) / (step[0] * across).sum(axis=-1)
    center, side, up = low + at[:, None] * step
    x = ((points_m - center) * side).sum(axis=-1) / (side**2).sum(axis=-1)
    y = ((points_m - center) * up).sum(axis=-1) / (up**2).sum(axis=-1)
    center, side, up = new[:, segment] + at[:, None] * (new[:, segment + 1] - new[:, segment])
    carried: Array = center + x[:, None] * side + y[:, None] * up
    return carried
