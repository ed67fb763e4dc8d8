"""Keypoint results in the order of the truth, for drogues that look the same after a turn."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from pycocotools.coco import COCO

from geometry.se3 import Array
from labelgen.export.annotations.coco import NAMESPACE


def align_keypoint_orders(truth: COCO, results: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Keypoint results in the symmetric order that fits the truth best, to be scored by `COCOeval`.

    An evenly spaced ring of eight looks the same after each of eight turns, so a detector may begin with any marker.
    Results may be in the drogue's own order or clockwise from the top of the image, as `keypoint_order_in_image`; of
    both and their turns, the one with the smallest sum of squared distances is taken. Orders that are no turn of
    either, such as the mirrored one of a shipped ring, remain errors. Drogues beside the sought one have no keypoints
    and are passed over.

    Args:
        truth: a file of `write_coco` or a dataset's `annotations`.
        results: as for `COCO.loadRes`, with `keypoints` in the drogue's order or that in the image, after any turn.

    Returns:
        Copies of the results; those on images without the sought drogue are unchanged.

    Raises:
        ValueError: a result with another number of keypoints than the truth has.
    """
    return [
        _best_order(
            result,
            [entry for entry in truth.imgToAnns[result["image_id"]] if "equal_keypoint_orders" in entry[NAMESPACE]],
        )
        for result in results
    ]


def _best_order(result: dict[str, Any], drogues: list[dict[str, Any]]) -> dict[str, Any]:
    points = np.array(result["keypoints"], dtype=np.float64).reshape(-1, 3)
    best, least = points, np.inf
    for drogue in drogues:
        want = np.array(drogue["keypoints"], dtype=np.float64).reshape(-1, 3)
        if want.shape != points.shape:
            raise ValueError(f"keypoints: must be {len(want)} in every result, got {len(points)}")
        own = np.array(drogue[NAMESPACE]["equal_keypoint_orders"], dtype=np.int64)
        in_image = own[:, drogue[NAMESPACE]["keypoint_order_in_image"]]
        for order in (*own, *in_image):
            ordered = points.copy()
            ordered[order] = points[: len(order)]
            error = _squared_distance_px2(ordered, want)
            if error < least:
                best, least = ordered, error
    return {**result, "keypoints": best.ravel().tolist()}


def _squared_distance_px2(points: Array, want: Array) -> float:
    shown = want[:, 2] > 0
    return float(((points[shown, :2] - want[shown, :2]) ** 2).sum())
