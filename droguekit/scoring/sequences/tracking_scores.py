"""Boxes that track the drogue through sequences: overlap with the true boxes, losses, and finding the drogue again.

Source of the curves: Y. Wu, J. Lim, M.-H. Yang, CVPR 2013, doi:10.1109/CVPR.2013.312, success and precision plots;
M. Mueller et al., TrackingNet, ECCV 2018, doi:10.1007/978-3-030-01246-5_19, precision normalised by the size of the
true box.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.types.estimates import Estimate, Region
from datasets_manifest.types.records import PixelBox
from droguekit.scoring.confidence_intervals import mean_interval, rate_interval, root_mean_square
from droguekit.scoring.results.detection_result import DetectedBox, center_box, clipped_box, corner_box
from droguekit.scoring.results.sequence_result import (
    EyeTracking,
    OverlapRow,
    Reacquisition,
    SourceTracking,
    Tracking,
    TrackLosses,
)
from droguekit.scoring.sequences.sequence_latency import processing_time_s
from droguekit.scoring.sequences.sequence_truth import TrueSequence, Visibility
from geometry.boxes import intersection_over_union
from geometry.se3 import Array
from geometry.stereo import EYES, Eye

OVERLAPS: Array = np.linspace(0.0, 1.0, 21)
"""Overlaps of the success plot."""
CENTER_ERRORS_PX: Array = np.arange(0.0, 51.0)
"""Distances of the precision plot. [px]"""
NORMALIZED_ERRORS: Array = np.linspace(0.0, 0.5, 51)
"""Distances of the normalised precision plot, in sizes of the true box."""
PRECISION_AT_PX = 20.0
"""Where the precision plot is read off. [px]"""
NO_BOX = (np.nan, np.nan, np.nan, np.nan)
LEAST_TRACKED_OVERLAP = 0.1
"""A box that overlaps the true one by less has lost the drogue (our choice)."""
LEAST_FOUND_OVERLAP = 0.5
"""A box with at least this overlap has found the drogue again, as for a detector."""
REACQUISITION_LIMIT_FRAMES = 3
"""A drogue should be found again within this number of frames."""
StageTimes = Mapping[int, Mapping[str, float]]
# Stages of an estimate that detect or track the box, or update the tracker.
_BOX_STAGES = frozenset({"detect", "track", "correct"})


@dataclass(frozen=True)
class SourcedBox:
    """A box in pixel-centre coordinates, and the name of its source, which may be empty."""

    box_px: PixelBox
    source: str


Boxes = Mapping[tuple[int, Eye], SourcedBox]


@dataclass(frozen=True, eq=False)
class EyeTrack:
    """The images of one eye through one sequence.

    Attributes:
        sequence_id, period_s: of the sequence.
        frame_index: (n,) of the pairs.
        visibilities: of the drogue in each image.
        found, truth: (n, 4) boxes, nan where there is none. [px]
        sources: of each found box; None without one.
    """

    sequence_id: int
    period_s: float
    frame_index: tuple[int, ...]
    visibilities: tuple[Visibility, ...]
    found: Array
    truth: Array
    sources: tuple[str | None, ...]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,) whether the drogue is to be found."""
        return np.array([visibility == "seen" for visibility in self.visibilities])

    @property
    def overlap(self) -> Array:
        """(n,) intersection over union; 0 without a box."""
        return intersection_over_union(self.found, self.truth)


def score_regions(sequences: Sequence[TrueSequence], estimates: Mapping[int, Estimate]) -> Tracking:
    """Scores of the regions that a method reports; without any, the drogue counts as lost everywhere.

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


def score_detected_boxes(
    sequences: Sequence[TrueSequence], found: Iterable[DetectedBox], threshold: float
) -> Tracking | None:
    """Scores of detected boxes: the best box of each image, if its score reaches the threshold.

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


def eye_tracks(
    sequences: Iterable[TrueSequence], boxes: Mapping[tuple[int, Eye], SourcedBox]
) -> dict[Eye, list[EyeTrack]]:
    """The images of every sequence, with the boxes found in them by frame and eye."""
    return {eye: [_eye_track(sequence, eye, boxes) for sequence in sequences] for eye in EYES}


def eye_tracking(tracks: Sequence[EyeTrack]) -> EyeTracking:
    """The scores of one eye's images."""
    return _track_scores(tracks, _losses(tracks))


def both_eyes_tracking(by_eye: Mapping[Eye, Sequence[EyeTrack]]) -> EyeTracking:
    """The scores of both eyes' images; losses are those of the eye that has more."""
    losses = [found for found in map(_losses, by_eye.values()) if found is not None]
    worse = max(losses, key=lambda found: (found.count, found.per_minute), default=None)
    return _track_scores([track for eye in EYES for track in by_eye[eye]], worse)


def overlap_row(tracks: Sequence[EyeTrack], chosen: Callable[[EyeTrack], NDArray[np.bool_]]) -> OverlapRow | None:
    """The OTB scores of the chosen images of each track; None where there are none."""
    picks = [chosen(track) for track in tracks]
    found, truth = (
        np.concatenate([getattr(track, name)[pick] for track, pick in zip(tracks, picks, strict=True)])
        for name in ("found", "truth")
    )
    if not len(found):
        return None
    blocks = np.repeat([track.sequence_id for track in tracks], [int(pick.sum()) for pick in picks]).tolist()
    overlap, errors = intersection_over_union(found, truth), center_errors_px(found, truth)
    success = success_curve(overlap)
    normalized = precision_curve(normalized_center_errors(found, truth), NORMALIZED_ERRORS)
    near, known = errors <= PRECISION_AT_PX, np.isfinite(errors)
    # The area under the plot is a mean over images too: of the share of thresholds that each passes.
    areas = np.mean(overlap[:, None] > OVERLAPS, axis=1)
    return OverlapRow(
        n=len(found),
        auc=float(success.mean()),
        auc_interval=mean_interval(areas, blocks, (0.0, 1.0)),
        mean_overlap=float(overlap.mean()),
        precision=float(near.mean()),
        precision_interval=mean_interval(near.astype(np.float64), blocks, (0.0, 1.0)),
        normalized_precision=float(normalized.mean()),
        center_rms_px=root_mean_square(errors[known]) if known.any() else None,
        success=tuple(success.tolist()),
        precisions=tuple(precision_curve(errors, CENTER_ERRORS_PX).tolist()),
        normalized=tuple(normalized.tolist()),
    )


def has_found(position_error_m: Array, rim_radius_m: float) -> bool:
    """Whether a pose has found the drogue again: its position (3,) errs by no more than the radius of the rim. [m]"""
    return float(np.linalg.norm(position_error_m)) <= rim_radius_m


def reacquisition(courses: Iterable[tuple[Sequence[Visibility], Sequence[bool]]]) -> Reacquisition:
    """How soon estimates come after the drogue was hidden, or had none beside the sun.

    Args:
        courses: for each sequence the visibility frame by frame, and whether there was an estimate.
    """
    delays = [delay for visibilities, estimated in courses for delay in _delays(visibilities, estimated)]
    came = [delay for delay in delays if delay is not None]
    return Reacquisition(
        n=len(delays),
        found=len(came),
        within_3=sum(delay <= REACQUISITION_LIMIT_FRAMES for delay in came),
        median_frames=float(np.median(came)) if came else None,
        max_frames=max(came, default=None),
    )


def center_errors_px(found: Array, truth: Array) -> Array:
    """(n,) distances of the centres of (n, 4) boxes; infinite where a box is `NO_BOX`. [px]"""
    return _lengths(_center_offsets(found, truth))


def normalized_center_errors(found: Array, truth: Array) -> Array:
    """(n,) the same with offsets to the side over the true box's width, and up or down over its height."""
    return _lengths(_center_offsets(found, truth) / truth[:, 2:])


def success_curve(overlap: Array) -> Array:
    """(21,) share of the images whose overlap is larger than each of `OVERLAPS`."""
    return _shares(overlap[:, None] > OVERLAPS)


def precision_curve(errors: Array, limits: Array) -> Array:
    """(len(limits),) share of the images whose error is at most each of the limits."""
    return _shares(errors[:, None] <= limits)


def _center_offsets(found: Array, truth: Array) -> Array:
    offsets: Array = found[:, :2] + found[:, 2:] / 2 - truth[:, :2] - truth[:, 2:] / 2
    return offsets


def _lengths(offsets: Array) -> Array:
    lengths: Array = np.nan_to_num(np.hypot(offsets[:, 0], offsets[:, 1]), nan=np.inf)
    return lengths


def _shares(passed: NDArray[np.bool_]) -> Array:
    shares: Array = np.mean(passed, axis=0)
    return shares


def _track_scores(tracks: Sequence[EyeTrack], losses: TrackLosses | None) -> EyeTracking:
    boxed = [box is not None for track in tracks for box in track.sources]
    hidden = [visibility == "hidden" for track in tracks for visibility in track.visibilities]
    found = [(track.overlap >= LEAST_FOUND_OVERLAP).tolist() for track in tracks]
    return EyeTracking(
        overlap=overlap_row(tracks, lambda track: track.seen),
        losses=losses,
        reacquisition=reacquisition((track.visibilities, hits) for track, hits in zip(tracks, found, strict=True)),
        hidden=sum(hidden),
        hidden_with_box=sum(h and b for h, b in zip(hidden, boxed, strict=True)),
    )


def _delays(visibilities: Sequence[Visibility], estimated: Sequence[bool]) -> Iterator[int | None]:
    """Frames from each re-appearance to an estimate, or None where none came before the drogue was hidden again."""
    hidden, since = False, None
    for k, (visibility, has_estimate) in enumerate(zip(visibilities, estimated, strict=True)):
        if visibility == "seen" and hidden:
            hidden, since = False, k
        elif visibility == "hidden" or (visibility == "dazzled" and not has_estimate):
            if since is not None:
                yield None
            hidden, since = True, None
        if since is not None and has_estimate:
            yield k - since
            since = None
    if since is not None:
        yield None


def _losses(tracks: Sequence[EyeTrack]) -> TrackLosses | None:
    seen_s = sum(float(track.seen.sum()) * track.period_s for track in tracks)
    if not seen_s:
        return None
    count = sum(_losses_of(track) for track in tracks)
    lost = np.concatenate([track.overlap[track.seen] < LEAST_TRACKED_OVERLAP for track in tracks])
    return TrackLosses(
        minutes=seen_s / 60,
        count=count,
        per_minute=60 * count / seen_s,
        per_minute_interval=rate_interval(count, seen_s / 60),
        lost_fraction=float(lost.mean()),
    )


def _losses_of(track: EyeTrack) -> int:
    count, followed = 0, False
    for visibility, overlap in zip(track.visibilities, track.overlap, strict=True):
        if visibility in ("hidden", "dazzled"):
            followed = False
        elif visibility == "seen":
            held = bool(overlap >= LEAST_TRACKED_OVERLAP)
            count += followed and not held
            followed = held
    return count


def _eye_track(sequence: TrueSequence, eye: Eye, boxes: Mapping[tuple[int, Eye], SourcedBox]) -> EyeTrack:
    states = sequence.states
    camera = states[0].rig.camera
    size_px = (camera.width_px, camera.height_px)
    on_image = [_on_image(boxes.get((state.frame_index, eye)), size_px) for state in states]
    truths = [state.eyes[eye].box_px for state in states]
    return EyeTrack(
        sequence_id=sequence.sequence_id,
        period_s=sequence.period_s,
        frame_index=tuple(state.frame_index for state in states),
        visibilities=tuple(state.eyes[eye].visibility for state in states),
        found=np.array([NO_BOX if box is None else box.box_px for box in on_image], dtype=np.float64),
        truth=np.array([NO_BOX if box is None else box for box in truths], dtype=np.float64),
        sources=tuple(None if box is None else box.source for box in on_image),
    )


def _on_image(box: SourcedBox | None, size_px: tuple[int, int]) -> SourcedBox | None:
    """The part of a box that lies on the image, for the true one goes around pixels; None without any."""
    if box is None:
        return None
    clipped = clipped_box(corner_box(box.box_px), size_px)
    return None if clipped is None else SourcedBox(center_box(clipped), box.source)


def _tracking(sequences: Sequence[TrueSequence], boxes: Boxes, stages_s: StageTimes) -> Tracking:
    by_eye = eye_tracks(sequences, boxes)
    tracks = [track for eye in EYES for track in by_eye[eye]]
    sources = sorted({box.source for box in boxes.values() if box.source})
    return Tracking(
        both=both_eyes_tracking(by_eye),
        eyes={eye: eye_tracking(by_eye[eye]) for eye in EYES},
        sources={source: _source_tracking(source, tracks, stages_s) for source in sources},
    )


def _source_tracking(source: str, tracks: Sequence[EyeTrack], stages_s: StageTimes) -> SourceTracking:
    def is_own(track: EyeTrack) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.array([name == source for name in track.sources])

    pairs = {
        index for track in tracks for index, own in zip(track.frame_index, is_own(track).tolist(), strict=True) if own
    }
    reported = [stages_s[index] for index in sorted(pairs & stages_s.keys())]
    times_ms = [1e3 * work_s for work_s in map(processing_time_s, reported) if work_s is not None]
    box_ms = [
        1e3 * sum(spent_s for stage, spent_s in stages.items() if stage in _BOX_STAGES)
        for stages in reported
        if _BOX_STAGES & stages.keys()
    ]
    return SourceTracking(
        overlap=overlap_row(tracks, lambda track: is_own(track) & track.seen),
        pairs=len(pairs),
        box_ms=float(np.median(box_ms)) if box_ms else None,
        frame_ms=float(np.median(times_ms)) if times_ms else None,
        frame_p95_ms=float(np.percentile(times_ms, 95)) if times_ms else None,
    )


def _has_area(region: Region) -> bool:
    """Whether the box has an area; a box without one counts as none."""
    return min(region.box_xywh_px[2:]) > 0
