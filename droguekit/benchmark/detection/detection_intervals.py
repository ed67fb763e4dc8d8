"""How well average precision is known: whole scenes are drawn again, for images of one scene are not independent."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from datasets_manifest.random_streams import named_generator
from droguekit.benchmark.detection.detection_matching import RECALLS, Matches
from droguekit.benchmark.statistics import CONFIDENCE, RESAMPLES, Interval
from geometry.se3 import Array

Counts = NDArray[np.signedinteger[Any]]

# Numbers held at once: some tens of megabytes.
_NUMBERS_AT_ONCE = 4_000_000


def average_precision_interval(matches: Matches, overlaps: tuple[int, ...], key: str) -> Interval | None:
    """Percentile-bootstrap interval of average precision.

    Args:
        matches: on the images of a cell.
        overlaps: places among `IOU_THRESHOLDS` to take the mean over.
        key: of the random stream.

    Returns:
        None with fewer than two scenes that show a drogue, or where all resamples are alike, as without a single fault:
        scenes drawn again cannot tell how rare a fault is that none of them shows.

    Source: B. Efron, Ann. Statist. 7 (1979) 1, doi:10.1214/aos/1176344552; 1000 resamples of scenes.
    """
    scene_ids, _, drogues = _scenes(matches)
    if np.count_nonzero(drogues) < 2:
        return None
    rng = named_generator(key)
    times = rng.multinomial(len(scene_ids), np.full(len(scene_ids), 1 / len(scene_ids)), RESAMPLES)
    # A resample without any drogue has no precision.
    drawn = times[times @ drogues > 0]
    values = np.mean([resampled_precision(matches, overlap, drawn) for overlap in overlaps], axis=0)
    low, high = np.percentile(values, (50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)))
    return (float(low), float(high)) if low < high else None


def resampled_precision(matches: Matches, overlap: int, times: Counts) -> Array:
    """Average precision where scenes are there several times, or not at all.

    Args:
        matches: on the images of a cell.
        overlap: place among `IOU_THRESHOLDS`.
        times: (R, S) how often each scene is there, in ascending order of their ids; some drogue must be.

    Returns:
        (R,) average precision at that overlap.
    """
    _, scene, drogues = _scenes(matches)
    true = matches.is_true[overlap]
    places = np.flatnonzero(true)
    if not len(places):
        return np.zeros(len(times))
    scene_of_box = scene[matches.image[: places[-1] + 1]]
    # Precision falls between true boxes: only what it is at each of them counts. (S, T) boxes of each scene since the
    # true box before, which is nearly nothing everywhere.
    segment = np.searchsorted(places, np.arange(places[-1] + 1))
    shape = (times.shape[1], len(places))
    all_boxes = csr_matrix((np.ones(len(segment)), (scene_of_box, segment)), shape=shape)
    true_boxes = csr_matrix((np.ones(len(places)), (scene_of_box[places], np.arange(len(places)))), shape=shape)
    step = max(1, _NUMBERS_AT_ONCE // len(places))
    parts = []
    for start in range(0, len(times), step):
        drawn = times[start : start + step].astype(np.float64)
        hits, boxes = (np.cumsum(drawn @ counts, axis=1) for counts in (true_boxes, all_boxes))
        precision = np.divide(hits, boxes, out=np.zeros_like(hits), where=boxes > 0)
        envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
        recall = hits / (drawn @ drogues)[:, None]
        parts.append([_sampled_mean(r, p) for r, p in zip(recall, envelope, strict=True)])
    return np.concatenate(parts)


def _scenes(matches: Matches) -> tuple[Counts, Counts, Counts]:
    """Ids of the scenes, the place of each image's among them, and how many drogues each shows."""
    ids, scene = np.unique([image.scene_id for image in matches.images], return_inverse=True)
    return ids, scene, np.bincount(scene[matches.has_drogue], minlength=len(ids))


def _sampled_mean(recall: Array, envelope: Array) -> float:
    place = np.searchsorted(recall, RECALLS, side="left")
    return float(envelope[place[place < len(envelope)]].sum() / len(RECALLS))


def scene_count(matches: Matches) -> int:
    """Scenes that show a drogue to be found."""
    return len({image.scene_id for image in matches.images if image.box_xywh is not None})
