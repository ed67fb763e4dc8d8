"""Part id, depth and normal where the rays through the pixel centres of an eye hit flat rings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.frame import FrameSpec
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.circles import disc_outline
from geometry.distortion import Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import Array
from geometry.stereo import Eye
from render.analytic_engine.flat_drogue import EyeView, FlatDrogue, FlatRing, flat_drogue
from render.surfaces import missing_parts

_OUTLINE_POINTS = 128
# Covers the chords of the outline, which deviate from the circle by 3e-4 of its radius.
_MARGIN_PX = 2


@dataclass(frozen=True, eq=False)
class PixelPasses:
    """The passes of `EyeRadiance` that follow from the pixel centres."""

    part_id: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    normal: NDArray[np.float32]
    amodal_px: dict[int, int]


@dataclass(frozen=True, eq=False)
class _RowSpans:
    """For consecutive rows of the image the columns from `first` to `last`; empty where `last < first`."""

    top: int
    first: NDArray[np.int64]
    last: NDArray[np.int64]


def empty_passes(camera: PinholeCamera) -> PixelPasses:
    """Passes of an eye that sees nothing but the background."""
    shape = (camera.height_px, camera.width_px)
    depth = np.full(shape, np.inf, dtype=np.float32)
    return PixelPasses(
        part_id=np.zeros(shape, np.uint8), depth_m=depth, normal=np.zeros((*shape, 3), np.float32), amodal_px={}
    )


def pixel_passes(flat: FlatDrogue, view: EyeView) -> PixelPasses:
    """What the rays through the pixel centres of one eye hit first."""
    passes = empty_passes(view.rig.camera)
    axis = view.left_from_drogue.rotation[:, 2]
    lens = view.rig.lens(view.eye)
    for ring in flat.back_to_front:
        met = _ideal_ring_pixels(ring, view) if lens is None else lens_ring_pixels(ring, view, lens)
        if met is None:
            continue
        count = int(np.count_nonzero(met.inside))
        if count and (ring.part >= FIRST_MARKER_ID or ring.part == Part.HUB):
            passes.amodal_px[ring.part] = count
        if view.sees_front or ring in flat.front:
            window = met.rows, met.columns
            np.copyto(passes.part_id[window], np.uint8(ring.part), where=met.inside)
            np.copyto(passes.depth_m[window], met.depth_m, where=met.inside)
    normal = (-axis if view.sees_front else axis).astype(np.float32)
    covered = passes.part_id != Part.SKY
    for row in np.flatnonzero(covered.any(axis=1)):
        passes.normal[row, covered[row]] = normal
    return passes


def _ideal_ring_pixels(ring: FlatRing, view: EyeView) -> RingPixels | None:
    """The pixel centres of an ideal eye whose rays hit a ring, or None where none does."""
    spans = _disc_spans(ring, ring.outer_radius_m, view)
    if not len(spans.first):
        return None
    rows = slice(spans.top, spans.top + len(spans.first))
    columns = slice(int(spans.first.min()), int(spans.last.max()) + 1)
    u = np.arange(columns.start, columns.stop)
    inside = (u >= spans.first[:, None]) & (u <= spans.last[:, None])
    if ring.inner_radius_m > 0:
        hole = _disc_spans(ring, ring.inner_radius_m, view)
        here = slice(hole.top - spans.top, hole.top - spans.top + len(hole.first))
        inside[here] &= (u < hole.first[:, None]) | (u > hole.last[:, None])
    axis = view.left_from_drogue.rotation[:, 2]
    depth_m = _plane_depth_m(view.center_m(ring), axis, view.rig.camera, rows, u)
    return RingPixels(rows=rows, columns=columns, inside=inside, depth_m=depth_m)


def _plane_depth_m(
    center_m: Array, axis: Array, camera: PinholeCamera, rows: slice, columns: NDArray[np.int64]
) -> NDArray[np.float32]:
    """(h, w) planar depth at which rays through pixel centres hit a plane across the axis. [m]"""
    along_x = axis[0] / camera.fx_px * (columns - camera.cx_px) + axis[2]
    along_y = axis[1] / camera.fy_px * (np.arange(rows.start, rows.stop) - camera.cy_px)
    depth: NDArray[np.float32] = ((center_m @ axis) / (along_y[:, None] + along_x)).astype(np.float32)
    return depth


def _disc_spans(ring: FlatRing, radius_m: float, view: EyeView) -> _RowSpans:
    """The pixel centres on the image whose rays hit a disc.

    The ray x hits the plane at `x (t.n) / (x.n)`, and lies within the radius of t where
    `|x (t.n) - t (x.n)|^2 <= r^2 (x.n)^2`: a conic in the image, solved for the two columns of every row.
    """
    camera, axis, center_m = view.rig.camera, view.left_from_drogue.rotation[:, 2], view.center_m(ring)
    reach = (center_m @ axis) * np.eye(3) - np.outer(center_m, axis)
    quadric = reach.T @ reach - radius_m**2 * np.outer(axis, axis)
    # Coordinates relative to the disc's centre avoid cancellation.
    middle = camera.project(center_m)
    matrix = camera.matrix()
    matrix[:2, 2] -= middle
    inverse = np.linalg.inv(matrix)
    conic = inverse.T @ quadric @ inverse
    if conic[0, 0] <= 0:
        return _RowSpans(0, np.zeros(0, np.int64), np.zeros(0, np.int64))
    v = np.arange(camera.height_px) - middle[1]
    half = conic[0, 1] * v + conic[0, 2]
    rest = conic[1, 1] * v**2 + 2 * conic[1, 2] * v + conic[2, 2]
    root = half**2 - conic[0, 0] * rest
    crossed = np.flatnonzero(root >= 0)
    if not len(crossed):
        return _RowSpans(0, np.zeros(0, np.int64), np.zeros(0, np.int64))
    rows = slice(crossed[0], crossed[-1] + 1)
    width = np.sqrt(np.maximum(root[rows], 0.0))
    first = np.ceil((-half[rows] - width) / conic[0, 0] + middle[0])
    last = np.floor((-half[rows] + width) / conic[0, 0] + middle[0])
    on_image = np.clip(first, 0, camera.width_px), np.clip(last, -1, camera.width_px - 1)
    return _RowSpans(int(rows.start), on_image[0].astype(np.int64), on_image[1].astype(np.int64))


@dataclass(frozen=True, eq=False)
class RingPixels:
    """A window of the image and its pixels that a ring covers.

    Attributes:
        rows, columns: where the window lies.
        inside: (h, w) whether the ray through a pixel centre hits the ring.
        depth_m: (h, w) planar depth at which it hits the ring's plane. [m]
    """

    rows: slice
    columns: slice
    inside: NDArray[np.bool_]
    depth_m: NDArray[np.float32]


@lru_cache(maxsize=2)
def _pixel_rays(lens: Lens) -> Array:
    """(H, W, 2) x and y at z = 1 of the rays through all pixel centres."""
    u, v = np.meshgrid(np.arange(lens.camera.width_px), np.arange(lens.camera.height_px))
    rays: Array = lens.rays(np.stack([u, v], axis=-1))[..., :2]
    return rays


def lens_ring_pixels(ring: FlatRing, view: EyeView, lens: Lens) -> RingPixels | None:
    """The pixel centres, of an eye with a lens, whose rays hit a ring; None for a ring outside the image."""
    outline_px = view.rig.image(
        disc_outline(view.left_from_drogue, ring.center_m, ring.outer_radius_m, _OUTLINE_POINTS), view.eye
    )
    size = np.array([lens.camera.width_px, lens.camera.height_px])
    low = np.clip(np.floor(outline_px.min(axis=0)).astype(int) - _MARGIN_PX, 0, size)
    high = np.clip(np.ceil(outline_px.max(axis=0)).astype(int) + _MARGIN_PX + 1, 0, size)
    if (low >= high).any():
        return None
    rows, columns = slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))
    rays = _pixel_rays(lens)[rows, columns]
    center_m, axis = view.center_m(ring), view.left_from_drogue.rotation[:, 2]
    x, y = rays[..., 0], rays[..., 1]
    depth_m = (center_m @ axis) / (x * axis[0] + y * axis[1] + axis[2])
    square_m2 = (x * depth_m - center_m[0]) ** 2 + (y * depth_m - center_m[1]) ** 2 + (depth_m - center_m[2]) ** 2
    inside = (square_m2 <= ring.outer_radius_m**2) & (square_m2 >= ring.inner_radius_m**2)
    return RingPixels(rows=rows, columns=columns, inside=inside, depth_m=depth_m.astype(np.float32))


def flat_part_masks(frame: FrameSpec, eye: Eye) -> dict[int, NDArray[np.bool_]]:
    """(H, W) by part id, the pixel centres whose rays would hit the part's rings if nothing occluded them.

    Empty for a frame without a drogue.
    """
    if frame.drogue is None or frame.left_from_drogue is None:
        return {}
    view = EyeView(frame.rig, eye, frame.left_from_drogue)
    masks: dict[int, NDArray[np.bool_]] = {}
    for ring in flat_drogue(frame.drogue, missing_parts(frame)).back_to_front:
        alone = pixel_passes(FlatDrogue((), (ring,), ()), view).part_id == ring.part
        masks[ring.part] = masks[ring.part] | alone if ring.part in masks else alone
    return masks
