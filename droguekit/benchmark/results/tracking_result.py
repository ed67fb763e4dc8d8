"""What `benchmark.json` says of boxes that follow the drogue through sequences."""

from __future__ import annotations

from droguekit.benchmark.results.result_parts import ResultModel
from droguekit.benchmark.statistics import Interval


class OverlapRow(ResultModel):
    """Boxes against the true ones, over images in which the drogue is to be found.

    Attributes:
        n: images.
        auc: area under the success plot: mean of `success`; `auc_interval` by resampled sequences.
        mean_overlap: mean intersection over union.
        precision: share of centres within 20 px of the true one; `precision_interval` as above.
        normalized_precision: mean of `normalized`.
        center_rms_px: root mean square distance of the centres, over the images with a box; null without any. [px]
        success: share of overlaps above 0, 0.05, ... 1.
        precisions: share of centres within 0, 1, ... 50 px.
        normalized: share of centres within 0, 0.01, ... 0.5 of the true box's size.
    """

    n: int
    auc: float
    auc_interval: Interval | None
    mean_overlap: float
    precision: float
    precision_interval: Interval | None
    normalized_precision: float
    center_rms_px: float | None
    success: tuple[float, ...]
    precisions: tuple[float, ...]
    normalized: tuple[float, ...]


class Losses(ResultModel):
    """How often a drogue that was followed got lost while it was there to be seen.

    A loss begins with the first image without a box, or with one that overlaps the true one by less than 0.1, after an
    image in which it was followed; no image in between hid or outshone the drogue.

    Of both eyes, it is that one which lost the drogue more often: mostly both lose it together, and two losses of one
    cause would make the interval too narrow.

    Attributes:
        minutes: for which the drogue was to be found.
        count: losses.
        per_minute: count over minutes; `per_minute_interval` by the Poisson law.
        lost_fraction: share of the images without such a box, found again or not.
    """

    minutes: float
    count: int
    per_minute: float
    per_minute_interval: Interval
    lost_fraction: float


class Reacquisition(ResultModel):
    """How soon an answer comes after the drogue was hidden, or lost beside the sun, and is seen again.

    Attributes:
        n: re-appearances, and appearances in a sequence that begins with a hidden drogue.
        found: of these, how often an answer came before it hid again, or the sequence ended.
        within_3: how often it came within 3 frames of the first one that shows the drogue again.
        median_frames, max_frames: delay where it came, 0 for that very first frame; null without any.
    """

    n: int
    found: int
    within_3: int
    median_frames: float | None
    max_frames: int | None


class EyeTracking(ResultModel):
    """Boxes in some images of all sequences.

    Attributes:
        overlap: images without a box count as an overlap of nothing; null where no image shows enough of the drogue.
        losses: null where `overlap` is.
        reacquisition: answers are boxes that overlap the true one by half or more.
        hidden: images in which nothing of the drogue is seen.
        hidden_with_box: of these, those with a box all the same.
    """

    overlap: OverlapRow | None
    losses: Losses | None
    reacquisition: Reacquisition
    hidden: int
    hidden_with_box: int


class SourceTracking(ResultModel):
    """The boxes of one source, `detector` or a tracker, over the images for which it gave one.

    Attributes:
        overlap: null where none of them was on an image that shows enough of the drogue.
        pairs: in which at least one box is its own.
        box_ms: median time of the stages `detect`, `track` and `correct`, which find or follow the box, in those
            pairs; null where none is told. [ms]
        frame_ms, frame_p95_ms: median and 95th percentile of the time of all stages together, but for those in which a
            pair only waits (`read`, `wait`, `handover`). [ms]
    """

    overlap: OverlapRow | None
    pairs: int
    box_ms: float | None
    frame_ms: float | None
    frame_p95_ms: float | None


class Tracking(ResultModel):
    """Boxes of one method, detector or tracker through all sequences.

    Attributes:
        both: the images of both eyes; `eyes`: of each.
        sources: by their names; empty where the boxes name none.
    """

    both: EyeTracking
    eyes: dict[str, EyeTracking]
    sources: dict[str, SourceTracking]
