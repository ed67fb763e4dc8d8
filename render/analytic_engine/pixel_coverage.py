"""The exact share of each pixel that polygons cover, and painting of parts weighted by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.se3 import Array
from geometry.stereo import Eye, StereoRig

# Sums of signed areas leave pixels that are wholly inside or outside within some 1e-12 of 1 or 0.
_ROUNDING = 1e-9
_NO_AREA = shapely.Polygon()
# A strong lens bends an edge of this length by 3e-3 px (curvature 1e-4 / px), and these edges lie outside the image.
_STRAIGHT_PX = 16.0


def image_area(rig: StereoRig, eye: Eye, outline_m: Array, hole_m: Array | None = None) -> Any:
    """The part of an eye's image inside an outline; what lies beyond the field of a lens is cut off.

    Args:
        rig, eye: which image.
        outline_m: (N, 3) around the area, in the left camera frame, in front of the eye. [m]
        hole_m: (M, 3) around a hole in it. [m]

    Returns:
        A shapely polygon, or several; empty where the lens sees nothing of the area. [px]
    """
    rings = [rig.project(ring, eye) for ring in (outline_m, *([] if hole_m is None else [hole_m]))]
    if all(rig.is_in_field(ring, eye).all() for ring in rings):
        outline_px, *holes_px = (rig.real_px(ring, eye) for ring in rings)
        return shapely.Polygon(outline_px, holes_px)
    field = shapely.box(*rig.field_px(eye).ravel())
    inside = shapely.intersection(shapely.Polygon(rings[0], rings[1:]), field)
    return shapely.transform(shapely.segmentize(inside, _STRAIGHT_PX), lambda ideal_px: rig.real_px(ideal_px, eye))


@dataclass(frozen=True, eq=False)
class PixelCoverage:
    """Coverage of the pixels of a rectangle of the image; coverage is 0 outside.

    Attributes:
        rows, columns: where it lies in the image.
        share: (h, w) covered shares, 0 to 1.
    """

    rows: slice
    columns: slice
    share: Array


def pixel_coverage(areas: Sequence[Any], width_px: int, height_px: int) -> PixelCoverage | None:
    """Mean coverage by several areas, as at several moments of an exposure.

    Args:
        areas: shapely polygons or multipolygons, in pixel coordinates. [px]
        width_px, height_px: size of the image.

    Returns:
        Exact up to rounding, or None where no area reaches the image.

    Source: Green's theorem. An edge piece within one pixel covers, to its right, `dy` times its mean distance from the
    pixel's right side there, and `dy` of every further pixel of the row; the signed sum over all edges is the area.
    """
    image = shapely.box(-0.5, -0.5, width_px - 0.5, height_px - 0.5)
    inside = [area if shapely.covers(image, area) else shapely.intersection(area, image) for area in areas]
    # An area that only touches the image leaves a line or a point of it.
    bounds = np.array([shapely.bounds(area) for area in inside if shapely.area(area) > 0])
    if not len(bounds):
        return None
    # From here on pixel i is the interval from i to i + 1 of the window.
    low = np.floor(bounds[:, :2].min(axis=0) + 0.5).astype(int)
    size = np.ceil(bounds[:, 2:].max(axis=0) + 0.5).astype(int) - low
    start, end = (np.concatenate(points) + 0.5 - low for points in zip(*map(_edges, inside), strict=True))
    start, end = _split_at_integers(*_split_at_integers(start, end, 1), 0)
    rise = end[:, 1] - start[:, 1]
    middle = (start + end) / 2
    # A piece on the window's far side lies in no pixel of it and covers nothing to its right.
    pixel = np.clip(np.floor(middle).astype(np.int64), 0, size - 1)
    into = middle[:, 0] - pixel[:, 0]
    # One more column takes what belongs beyond the last one.
    flat = pixel[:, 1] * (size[0] + 1) + pixel[:, 0]
    cells = (size[0] + 1) * size[1]
    change = np.bincount(flat, rise * (1.0 - into), cells) + np.bincount(flat + 1, rise * into, cells)
    share = change.reshape(size[1], size[0] + 1).cumsum(axis=1)[:, :-1] / len(areas)
    share[np.abs(share) < _ROUNDING] = 0.0
    share[np.abs(share - 1.0) < _ROUNDING] = 1.0
    return PixelCoverage(rows=slice(low[1], low[1] + size[1]), columns=slice(low[0], low[0] + size[0]), share=share)


def _edges(area: Any) -> tuple[Array, Array]:
    """(E, 2) starts and ends of all edges; outer rings run upwards on their left, holes on their right."""
    starts, ends = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for polygon in shapely.get_parts(area):
        # An intersection with the image may leave points and lines beside the polygons.
        if shapely.get_type_id(polygon) != shapely.GeometryType.POLYGON:
            continue
        for index, ring in enumerate([polygon.exterior, *polygon.interiors]):
            points = shapely.get_coordinates(ring)
            upwards_on_the_right = shapely.is_ccw(ring)
            if upwards_on_the_right == (index == 0):
                points = points[::-1]
            starts.append(points[:-1])
            ends.append(points[1:])
    return np.concatenate(starts), np.concatenate(ends)


def _split_at_integers(start: Array, end: Array, axis: int) -> tuple[Array, Array]:
    """Edges cut wherever a coordinate passes an integer.

    Args:
        start, end: (E, 2) ends of the edges.
        axis: the coordinate.

    Returns:
        (P, 2) starts and ends of the pieces.
    """
    a, b = start[:, axis], end[:, axis]
    first: NDArray[np.float64] = np.floor(np.minimum(a, b)) + 1
    last: NDArray[np.float64] = np.ceil(np.maximum(a, b)) - 1
    pieces = np.maximum(last - first + 1, 0).astype(np.int64) + 1
    edge = np.repeat(np.arange(len(start)), pieces)
    index = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    rises = (b > a)[edge]
    cut = np.where(rises, first[edge] + index, last[edge] - index)
    run = np.where(b == a, 1.0, b - a)[edge]
    share = ((cut - a[edge]) / run)[:, None]
    stops = np.where((index == pieces[edge] - 1)[:, None], end[edge], start[edge] + share * (end - start)[edge])
    starts = np.where((index == 0)[:, None], start[edge], np.roll(stops, 1, axis=0))
    return starts, stops


def paint(
    moments: Sequence[dict[int, Any]], radiance: dict[int, Array], background: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Paint parts over the background.

    Args:
        moments: areas by part id (see `flat_drogue.visible_areas`), at evenly spaced moments of the exposure.
        radiance: (3,) radiance by part id. [cd/m2]
        background: (H, W, 3) radiance. [cd/m2]

    Returns:
        (H, W, 3) radiance [cd/m2], and (H, W) share of each pixel that parts cover.
    """
    height_px, width_px = background.shape[:2]
    coverage = np.zeros((height_px, width_px), dtype=np.float32)
    painted = []
    for part in dict.fromkeys(part for areas in moments for part in areas):
        covered = pixel_coverage([areas.get(part, _NO_AREA) for areas in moments], width_px, height_px)
        if covered is not None:
            share = covered.share.astype(np.float32)
            painted.append((part, covered.rows, covered.columns, share))
            if _painted_on(part) == Part.SKY:
                coverage[covered.rows, covered.columns] += share
    image = background.copy()
    for part, rows, columns, _ in painted:
        if _painted_on(part) == Part.SKY:
            # Windows may overlap, so that each weights the background again.
            open_share = 1.0 - coverage[rows, columns]
            for channel in range(3):
                np.multiply(background[rows, columns, channel], open_share, out=image[rows, columns, channel])
    for part, rows, columns, share in painted:
        under = _painted_on(part)
        adds = (radiance[part] - (radiance[under] if under != Part.SKY else 0.0)).astype(np.float32)
        # By channel: a product over (h, w, 1) and (3,) takes three times as long.
        for channel in range(3):
            image[rows, columns, channel] += share * adds[channel]
    return image, coverage


def _painted_on(part: int) -> int:
    """The part that another part is painted on."""
    if part == Part.HUB:
        return int(Part.COUPLING)
    return int(Part.FACE) if part >= FIRST_MARKER_ID else int(Part.SKY)
