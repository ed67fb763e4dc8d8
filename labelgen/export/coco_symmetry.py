"""Keypoints of drogues that look the same after a turn, brought into the truth's order before COCO's evaluation."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from pycocotools.coco import COCO

from geometry.se3 import Array
from labelgen.export.coco_entries import DROGUE, NAMESPACE


def rolled_to_truth(truth: COCO, results: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Keypoint results in that one of the equal orders which fits the truth best; `COCOeval` then scores them as usual.

    An even ring of eight looks the same after each of eight turns, so a detector may begin with any marker. Its result
    counts as the best of the turns, the minimum of the squared distances over them; orders that are not a turn of the
    drogue, such as the mirrored one, stay wrong.

    Args:
        truth: a file of `write_coco` or a dataset's `annotations`.
        results: as for `COCO.loadRes`, with `keypoints` in any of the equal orders, that in the image among them.

    Returns:
        Copies of the results. Those on images without a drogue are as they were.

    Raises:
        ValueError: a result with another number of keypoints than the truth has.
    """
    return [
        _best_roll(result, [entry for entry in truth.imgToAnns[result["image_id"]] if entry["category_id"] == DROGUE])
        for result in results
    ]


def _best_roll(result: dict[str, Any], drogues: list[dict[str, Any]]) -> dict[str, Any]:
    points = np.array(result["keypoints"], dtype=np.float64).reshape(-1, 3)
    best, least = points, np.inf
    for drogue in drogues:
        want = np.array(drogue["keypoints"], dtype=np.float64).reshape(-1, 3)
        if want.shape != points.shape:
            raise ValueError(f"keypoints: must be {len(want)} in every result, got {len(points)}")
        for order in drogue[NAMESPACE]["equal_keypoint_orders"]:
            rolled = points.copy()
            rolled[list(order)] = points[: len(order)]
            error = _squared_distance_px2(rolled, want)
            if error < least:
                best, least = rolled, error
    return {**result, "keypoints": best.ravel().tolist()}


def _squared_distance_px2(points: Array, want: Array) -> float:
    shown = want[:, 2] > 0
    return float(((points[shown, :2] - want[shown, :2]) ** 2).sum())
