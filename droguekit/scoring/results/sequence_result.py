"""Types of the part `sequences` of `benchmark.json`: tracking, motion, docking, latency."""

from __future__ import annotations

from droguekit.scoring.confidence_intervals import Interval
from droguekit.scoring.results.pose_result import MethodComparison, NeesPart, ResultModel


class BodyAxes(ResultModel):
    """One number for each of the receiver's body axes."""

    forward: float
    right: float
    down: float


class Calibration(ResultModel):
    """How often errors stay within their standard deviations; 68.3 and 95.4 % for a normal law.

    Attributes:
        n: errors that come with a standard deviation above 0.
        within_1, within_2: share within once and twice that.
    """

    n: int
    within_1: float
    within_2: float


class MissRow(ResultModel):
    """The predicted miss against the true one.

    Attributes:
        n: pairs in which both exist.
        bias_m, rmse_m, median_absolute_m, p95_m: of the difference, the last two of its size. Where the drogue hardly
            comes nearer, a straight way leads far off, and a few such pairs rule mean and root mean square. [m]
        calibration: of it; null without standard deviations.
    """

    n: int
    bias_m: float
    rmse_m: float
    median_absolute_m: float
    p95_m: float
    calibration: Calibration | None


class Captures(ResultModel):
    """Predicted against true captures.

    Attributes:
        radius_m: capture radius that the estimates report, or the drogue's own; null where pairs differ. Each pair is
            judged by its own. [m]
        true_yes, false_yes, false_no, true_no: number of captures that were predicted or not, rightly or wrongly.
    """

    radius_m: float | None
    true_yes: int
    false_yes: int
    false_no: int
    true_no: int


class DockingRow(ResultModel):
    """The drogue as the probe sees it, estimate minus truth, over some pairs.

    Attributes:
        n, of: pairs with docking quantities, of those whose true ones are known.
        mouth_rmse_m, mouth_bias_m: of the place of the mouth. [m]
        mouth_rms_m: of the length of that error; `mouth_interval` is Student's over sequences. [m]
        calibration: of each axis.
        closure_n, closure_rmse_m_s, closure_bias_m_s: of the closure where it is known; null without any. [m/s]
        contact_median_absolute_s: size of the error of the time until the rim; null without any. [s]
        miss: against the miss that the true motion of that instant leads to.
        miss_in_the_end: against what the sequence later brought; null where the tip never comes to the rim, or only
            after a gap between pairs.
        captures, captures_in_the_end: of the same two; null where none was reported.
    """

    n: int
    of: int
    mouth_rmse_m: BodyAxes
    mouth_bias_m: BodyAxes
    mouth_rms_m: float
    mouth_interval: Interval | None
    calibration: dict[str, Calibration | None]
    closure_n: int
    closure_rmse_m_s: float | None
    closure_bias_m_s: float | None
    contact_median_absolute_s: float | None
    miss: MissRow | None
    miss_in_the_end: MissRow | None
    captures: Captures | None
    captures_in_the_end: Captures | None


class DockingBin(DockingRow):
    """A row of the distances from `low_m` to `high_m`. [m]"""

    low_m: float
    high_m: float


class DockingErrors(ResultModel):
    """All pairs, then by distance."""

    overall: DockingRow
    bins: tuple[DockingBin, ...]


class OverlapRow(ResultModel):
    """Boxes against the true ones, over images in which the drogue is to be found.

    Attributes:
        n: images.
        auc: area under the success plot: mean of `success`; `auc_interval` is Student's over sequences.
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


class TrackLosses(ResultModel):
    """How often a tracked drogue was lost while it was visible.

    A loss begins with the first image without a box, or with one that overlaps the true one by less than 0.1, after an
    image in which it was tracked; in no image in between was the drogue hidden or dazzled by the sun.

    Of both eyes, the one with more losses counts: mostly both lose the drogue together, and counting one cause twice
    would make the interval too narrow.

    Attributes:
        minutes: for which the drogue was visible.
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
    """How soon an estimate comes after the drogue was hidden, or lost beside the sun, and is visible again.

    Attributes:
        n: re-appearances, and appearances in a sequence that begins with a hidden drogue.
        found: of these, how often an estimate came before it was hidden again or the sequence ended.
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
        reacquisition: by boxes that overlap the true one by half or more.
        hidden: images in which nothing of the drogue is seen.
        hidden_with_box: of these, those with a box all the same.
    """

    overlap: OverlapRow | None
    losses: TrackLosses | None
    reacquisition: Reacquisition
    hidden: int
    hidden_with_box: int


class SourceTracking(ResultModel):
    """The boxes of one source, `detector` or a tracker, over the images for which it gave one.

    Attributes:
        overlap: null where none of them was on an image that shows enough of the drogue.
        pairs: in which at least one box is its own.
        box_ms: median time of the stages `detect`, `track` and `correct`, which find or follow the box, in those
            pairs; null where none is reported. [ms]
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


class CameraAxes(ResultModel):
    """One number for each axis of the left camera."""

    x: float
    y: float
    z: float


class HiddenPairs(ResultModel):
    """Poses and the pairs in which the drogue is hidden.

    Attributes:
        hidden: pairs of sequences that show nothing of the drogue, or of none of its markers, in either image.
        poses_while_hidden: of these, those with a pose all the same; should be 0.
        reacquisition: after the drogue was hidden, or lost beside the sun, and both images show it again; by
            poses that err in position by the radius of the drogue's rim at the most.
    """

    hidden: int
    poses_while_hidden: int
    reacquisition: Reacquisition


class MotionRow(ResultModel):
    """Velocity and rate, estimate minus truth, over some pairs.

    Attributes:
        n, of: pairs with a motion, of those whose true one is known.
        velocity_rmse_m_s, rate_rmse_deg_s: by axis of the left camera. [m/s, deg/s]
        speed_rmse_m_s, turn_rmse_deg_s: of the lengths of both errors; `*_interval` is Student's over sequences.
    """

    n: int
    of: int
    velocity_rmse_m_s: CameraAxes
    speed_rmse_m_s: float
    speed_interval: Interval | None
    rate_rmse_deg_s: CameraAxes
    turn_rmse_deg_s: float
    turn_interval: Interval | None


class MotionBin(MotionRow):
    """A row of the distances from `low_m` to `high_m`. [m]"""

    low_m: float
    high_m: float


class MotionNees(ResultModel):
    """How well errors of the motion fit the reported covariances; their neighbours in time are not independent.

    Attributes:
        n, unusable: covariances that count, and that are not positive definite.
        velocity, rate: of three components each.
        motion: of all six; `interval` of its mean is Student's over sequences.
    """

    n: int
    unusable: int
    velocity: NeesPart | None
    rate: NeesPart | None
    motion: NeesPart | None
    interval: Interval | None


class Lag(ResultModel):
    """Delay of an estimate behind the truth.

    Attributes:
        lag_s: shift with the least squared error; null where there is no clear minimum. [s]
        interval: by resampled sequences.
    """

    lag_s: float | None
    interval: Interval | None


class FilterErrors(ResultModel):
    """Errors of a filter that works on a method's poses.

    Attributes:
        motion: null where no pair has both an estimate and a true motion; `bins` by distance.
        nees: null where `motion` is.
        lags: of each component of the pose; null where no sequence is long enough.
        raw: errors over those of the method that it filters, on the same pairs; null where the file lacks that.
    """

    motion: MotionRow | None
    bins: tuple[MotionBin, ...]
    nees: MotionNees | None
    lags: dict[str, Lag] | None
    raw: MethodComparison | None


class TimePercentiles(ResultModel):
    """Times of some pairs. [ms]"""

    n: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class LatencyBin(TimePercentiles):
    """The pairs whose drogue is from `low_m` to `high_m`. [m]"""

    low_m: float
    high_m: float


class Latency(ResultModel):
    """From the arrival of the images to the estimate.

    Attributes:
        overall: pairs of sequences that report it and were processed; null without any.
        bins: by true distance.
        stages: of the stages' own times.
        answers: pairs with an estimate or a reason.
        late: of these, those that were skipped because newer ones had arrived.
    """

    overall: TimePercentiles | None
    bins: tuple[LatencyBin, ...]
    stages: dict[str, TimePercentiles]
    answers: int
    late: int
    late_fraction: float


class MethodSequences(ResultModel):
    """One method over all sequences.

    Attributes:
        hiding: poses while the drogue is hidden, and after.
        tracking: of its regions; null where no method has any.
        filtering: null where it reports no motion.
        docking: null without docking quantities.
        latency: null where no estimate reports one, and no pair was late.
    """

    hiding: HiddenPairs
    tracking: Tracking | None
    filtering: FilterErrors | None
    docking: DockingErrors | None
    latency: Latency | None


class SequencesResult(ResultModel):
    """All scores that are only defined over sequences.

    Attributes:
        count, pairs: sequences, and pairs in them.
        minutes: from the first to the last pair of each, together.
        vibration_rms_m_s: root mean square of the velocity that an instant has beyond the motion from pair to pair;
            null where no run of pairs is long enough. [m/s]
        methods: those that report any of the parts.
    """

    count: int
    pairs: int
    minutes: float
    vibration_rms_m_s: float | None
    methods: dict[str, MethodSequences]
