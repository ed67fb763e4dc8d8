"""Markers as keypoints: positions, visibility flags, and the equivalent orders of an evenly spaced ring."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.types.records import PairRecord, ViewRecord
from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters
from geometry.pinhole import PinholeCamera
from geometry.stereo import Eye
from labelgen.export.export_log import ExportLog

# A marker counts as visible if at least this share of its pixels is.
_VISIBLE_FROM_FRACTION = 0.5
CORNER_FROM_CENTER_PX = 0.5
"""Offset of formats whose origin is the image's corner from the records' pixel-centre coordinates. [px]"""
MIN_KEYPOINTS = 8
"""Drogues with fewer markers get absent keypoints up to this number, so that one network fits all datasets."""


class Keypoint(NamedTuple):
    """A marker's centre from the image's corner [px]; flag 0 outside the image (x = y = 0), 1 hidden, 2 visible.

    A marker of which less than half is visible counts as hidden.
    """

    x: float
    y: float
    flag: int


ABSENT = Keypoint(0.0, 0.0, 0)


def keypoint_count(manifest: Manifest) -> int:
    """Number of keypoints of every drogue in a dataset's exports: the largest number of markers, at least 8."""
    return max(MIN_KEYPOINTS, *(drogue.marker_count for drogue in manifest.recipe.drogues))


def view_of(record: PairRecord, eye: Eye) -> ViewRecord:
    """The labels of one eye."""
    return record.views.left if eye == "left" else record.views.right


def view_keypoints(view: ViewRecord, camera: PinholeCamera, count: int) -> list[Keypoint]:
    """The markers of a view in the drogue's order, padded with absent ones to `count`."""
    points = []
    for marker in view.markers:
        u, v = marker.center_proj_px
        if camera.contains(marker.center_proj_px):
            flag = 2 if marker.visible_fraction >= _VISIBLE_FROM_FRACTION else 1
            points.append(Keypoint(u + CORNER_FROM_CENTER_PX, v + CORNER_FROM_CENTER_PX, flag))
        else:
            points.append(ABSENT)
    return points + [ABSENT] * (count - len(points))


def clockwise_order(view: ViewRecord) -> list[int]:
    """Indices of the markers by their positions in the image: the one nearest the top first, then clockwise.

    An evenly spaced ring looks the same after a turn by one marker; this order does not depend on the marker's index.
    """
    if not view.markers:
        return []
    centers = np.array([marker.center_proj_px for marker in view.markers])
    right, down = (centers - centers.mean(axis=0)).T
    from_top = np.arctan2(right, -down)
    first = int(np.argmin(np.abs(from_top)))
    return [int(index) for index in np.argsort((from_top - from_top[first]) % (2 * np.pi), kind="stable")]


@lru_cache(maxsize=64)
def symmetric_orders(drogue: DrogueParameters) -> tuple[tuple[int, ...], ...]:
    """The permutations of the markers by turns that map the drogue onto itself, beginning with the identity.

    Returns:
        One for each of the `symmetry_order` turns: entry i is the index of the marker to whose position marker i moves.
    """
    layout = marker_layout(drogue)
    places = layout.centers_m[:, :2]
    if layout.count == 0:
        return ((),)
    orders = []
    for step in range(layout.symmetry_order):
        angle = 2 * np.pi * step / layout.symmetry_order
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        gaps = np.linalg.norm((places @ turn.T)[:, None] - places[None], axis=-1)
        orders.append(tuple(int(index) for index in gaps.argmin(axis=1)))
    return tuple(orders)


@lru_cache(maxsize=64)
def mirrored_order(drogue: DrogueParameters) -> tuple[int, ...] | None:
    """For each marker the one that takes its place in a mirrored image; None where the markers have no mirror axis.

    Of several axes it is the one through the first marker, or the next one.
    """
    layout = marker_layout(drogue)
    places, depths_m = layout.centers_m[:, 0] + 1j * layout.centers_m[:, 1], layout.centers_m[:, 2]
    off_axis = places[np.abs(places) > layout.tolerance_m]
    if not len(off_axis):
        return tuple(range(layout.count))
    for other in off_axis:
        # The mirror that takes the first marker towards this one.
        product = off_axis[0] * other
        mirrored = product / np.abs(product) * places.conj()
        gaps = np.hypot(np.abs(mirrored[:, None] - places), depths_m[:, None] - depths_m)
        if gaps.min(axis=1).max() < layout.tolerance_m:
            return tuple(int(index) for index in gaps.argmin(axis=1))
    return None


def log_cut_labels(log: ExportLog, record: PairRecord, eye: Eye) -> None:
    """Log a drogue without visible pixels, or whose box is cut at the image's border."""
    view = view_of(record, eye)
    if record.left_from_drogue is not None and view.box_visible_xywh_px is None:
        log.lost("views with a drogue of which no pixel is seen: without a label")
    elif record.left_from_drogue is not None:
        log.lost("drogues that leave the image: their boxes end at its border", int(view.truncated))


def log_absent_keypoints(log: ExportLog, points: list[Keypoint], marker_count: int) -> None:
    """Log how many of the markers, the first of the keypoints, are outside the image."""
    absent = sum(point.flag == 0 for point in points[:marker_count])
    log.lost("keypoints outside the image: without a place", absent)
