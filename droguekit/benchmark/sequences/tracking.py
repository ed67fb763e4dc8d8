"""Tracking scores of what a method reports, and of what a file of boxes holds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from datasets_manifest.types.estimates import Estimate, Region
from droguekit.benchmark.results.detection_boxes import FoundBox, center_box
from droguekit.benchmark.results.tracking_result import SourceTracking, Tracking
from droguekit.benchmark.sequences.sequence_latency import worked_s
from droguekit.benchmark.sequences.sequence_truth import TrueSequence
from droguekit.benchmark.sequences.tracking_scores import (
    EyeTrack,
    SourcedBox,
    both_eyes_tracking,
    eye_tracking,
    eye_tracks,
    overlap_row,
)
from geometry.stereo import EYES, Eye

Boxes = Mapping[tuple[int, Eye], SourcedBox]
StageTimes = Mapping[int, Mapping[str, float]]

# The stages of an estimate that find or follow the drogue's box, and teach the tracker.
_BOX_STAGES = frozenset({"detect", "track", "correct"})


def track_regions(sequences: Sequence[TrueSequence], estimates: Mapping[int, Estimate]) -> Tracking:
    """Scores of the regions that a method reports; one that reports none has lost the drogue everywhere.

    Args:
        sequences: the truth.
        estimates: of the method, by frame.
    """
    boxes = {
        (index, region.eye): SourcedBox(region.box_xywh_px, region.source)
        for index, estimate in estimates.items()
        # Of several in one eye the last one stays, which is the best.
        for region in sorted(estimate.regions, key=lambda region: region.score)
        if _has_area(region)
    }
    return _tracking(sequences, boxes, {i: estimate.stage_s for i, estimate in estimates.items()})


def track_found_boxes(
    sequences: Sequence[TrueSequence], found: Iterable[FoundBox], threshold: float
) -> Tracking | None:
    """Scores of a file of boxes: of each image the best one, if it scores at least the threshold.

    Returns:
        None without sequences.
    """
    if not sequences:
        return None
    best: dict[tuple[int, Eye], SourcedBox] = {}
    for box in sorted(found, key=lambda box: box.score):
        if box.score >= threshold:
            frame, eye = divmod(box.image_id - 1, len(EYES))
            best[frame, EYES[eye]] = SourcedBox(center_box(box.box_xywh), "")
    return _tracking(sequences, best, {})


def _tracking(sequences: Sequence[TrueSequence], boxes: Boxes, stages_s: StageTimes) -> Tracking:
    by_eye = eye_tracks(sequences, boxes)
    tracks = [track for eye in EYES for track in by_eye[eye]]
    sources = sorted({box.source for box in boxes.values() if box.source})
    return Tracking(
        both=both_eyes_tracking(by_eye),
        eyes={eye: eye_tracking(by_eye[eye], f"eye {eye}") for eye in EYES},
        sources={source: _source_tracking(source, tracks, stages_s) for source in sources},
    )


def _source_tracking(source: str, tracks: Sequence[EyeTrack], stages_s: StageTimes) -> SourceTracking:
    def is_own(track: EyeTrack) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.array([name == source for name in track.sources])

    pairs = {
        index for track in tracks for index, own in zip(track.frame_index, is_own(track).tolist(), strict=True) if own
    }
    told = [stages_s[index] for index in sorted(pairs & stages_s.keys())]
    times_ms = [1e3 * work_s for work_s in map(worked_s, told) if work_s is not None]
    box_ms = [
        1e3 * sum(spent_s for stage, spent_s in stages.items() if stage in _BOX_STAGES)
        for stages in told
        if _BOX_STAGES & stages.keys()
    ]
    return SourceTracking(
        overlap=overlap_row(tracks, lambda track: is_own(track) & track.seen, f"source {source}"),
        pairs=len(pairs),
        box_ms=float(np.median(box_ms)) if box_ms else None,
        frame_ms=float(np.median(times_ms)) if times_ms else None,
        frame_p95_ms=float(np.percentile(times_ms, 95)) if times_ms else None,
    )


def _has_area(region: Region) -> bool:
    """Whether the box is one; others are as good as none."""
    return min(region.box_xywh_px[2:]) > 0
