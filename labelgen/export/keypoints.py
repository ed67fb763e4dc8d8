"""Markers as keypoints: places, flags, and the orders that an even ring cannot tell apart."""

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

# A marker counts as visible from half of its pixels on.
_VISIBLE_FROM_FRACTION = 0.5
CORNER_FROM_CENTER_PX = 0.5
"""What formats that count from the image's corner add to the records' pixel-centre coordinates."""
MIN_KEYPOINTS = 8
"""Drogues with fewer markers get as many keypoints, the rest absent, so that all datasets fit one network."""


class Keypoint(NamedTuple):
    """A marker's centre, counted from the image's corner [px]; flag 0 outside the image (x = y = 0), 1 hidden, 2 seen.

    Hidden is a marker of which less than half can be seen.
    """

    x: float
    y: float
    flag: int


ABSENT = Keypoint(0.0, 0.0, 0)


def keypoint_count(manifest: Manifest) -> int:
    """Keypoints of every drogue in a dataset's exports: markers of the drogue with most of them, at least 8."""
    recipe = manifest.recipe
    counts = [recipe.drogue.marker_count, *(variant.drogue.marker_count for variant in recipe.variants)]
    return max(MIN_KEYPOINTS, *counts)


def view_of(record: PairRecord, eye: Eye) -> ViewRecord:
    """The truth of one eye."""
    return record.views.left if eye == "left" else record.views.right


def view_keypoints(view: ViewRecord, camera: PinholeCamera, count: int) -> list[Keypoint]:
    """The markers of a view in the drogue's order, filled up with absent ones to `count`."""
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
    """Indices of the markers as they stand in the image: the one nearest the top first, then clockwise.

    Even rings look the same after a turn by one marker; this order does not depend on which is which.
    """
    centers = np.array([marker.center_proj_px for marker in view.markers])
    right, down = (centers - centers.mean(axis=0)).T
    from_top = np.arctan2(right, -down)
    first = int(np.argmin(np.abs(from_top)))
    return [int(index) for index in np.argsort((from_top - from_top[first]) % (2 * np.pi), kind="stable")]


@lru_cache(maxsize=64)
def symmetric_orders(drogue: DrogueParameters) -> tuple[tuple[int, ...], ...]:
    """The orders of the markers that a turn of the drogue onto itself makes, beginning with the drogue's own.

    Returns:
        One for each of the `symmetry_order` turns: entry i is the place, by marker, to which marker i comes.
    """
    layout = marker_layout(drogue)
    places = layout.centers_m[:, :2]
    orders = []
    for step in range(layout.symmetry_order):
        angle = 2 * np.pi * step / layout.symmetry_order
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        gaps = np.linalg.norm((places @ turn.T)[:, None] - places[None], axis=-1)
        orders.append(tuple(int(index) for index in gaps.argmin(axis=1)))
    return tuple(orders)


def log_cut_labels(log: ExportLog, record: PairRecord, eye: Eye) -> None:
    """Tell the log what formats with visible boxes do not hold of a view's drogue."""
    view = view_of(record, eye)
    if record.left_from_drogue is not None and view.box_visible_xywh_px is None:
        log.lost("views with a drogue of which no pixel is seen: without a label")
    elif record.left_from_drogue is not None:
        log.lost("drogues that leave the image: their boxes end at its border", int(view.truncated))


def log_absent_keypoints(log: ExportLog, points: list[Keypoint], marker_count: int) -> None:
    """Tell the log how many of the markers, which come first among the keypoints, have no place."""
    absent = sum(point.flag == 0 for point in points[:marker_count])
    log.lost("keypoints outside the image: without a place", absent)
