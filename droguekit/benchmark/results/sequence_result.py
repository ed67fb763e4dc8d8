"""What `benchmark.json` says of estimates over sequences, beside the errors of their poses."""

from __future__ import annotations

from droguekit.benchmark.results.docking_result import DockingErrors
from droguekit.benchmark.results.result_parts import Comparison, NeesPart, ResultModel
from droguekit.benchmark.results.tracking_result import Reacquisition, Tracking
from droguekit.benchmark.statistics import Interval


class Axes(ResultModel):
    """One number for each axis of the left camera."""

    x: float
    y: float
    z: float


class HiddenPairs(ResultModel):
    """Poses and the pairs in which the drogue is hidden.

    Attributes:
        hidden: pairs of sequences that show nothing of the drogue, or of none of its markers, in either image.
        poses_while_hidden: of these, those with a pose all the same; should be 0.
        reacquisition: after the drogue was hidden, or lost beside the sun, and both images show it again; answers are
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
        speed_rmse_m_s, turn_rmse_deg_s: of the lengths of both errors; `*_interval` by resampled sequences.
    """

    n: int
    of: int
    velocity_rmse_m_s: Axes
    speed_rmse_m_s: float
    speed_interval: Interval | None
    rate_rmse_deg_s: Axes
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
        motion: of all six; `interval` of its mean by resampled sequences.
    """

    n: int
    unusable: int
    velocity: NeesPart | None
    rate: NeesPart | None
    motion: NeesPart | None
    interval: Interval | None


class Lag(ResultModel):
    """By how much an estimate is late.

    Attributes:
        lag_s: shift with the least squared error; null where none stands out. [s]
        interval: by resampled sequences.
    """

    lag_s: float | None
    interval: Interval | None


class Filtering(ResultModel):
    """What a filter makes of a method's poses.

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
    raw: Comparison | None


class Percentiles(ResultModel):
    """Times of some pairs. [ms]"""

    n: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class LatencyBin(Percentiles):
    """The pairs whose drogue stands from `low_m` to `high_m`. [m]"""

    low_m: float
    high_m: float


class Latency(ResultModel):
    """From the arrival of the images to the answer.

    Attributes:
        overall: all pairs of sequences that tell it and were worked on; null without any.
        bins: by true distance.
        stages: of the stages' own times.
        answers: pairs with an estimate or a reason.
        late: of these, those that were not worked on, because newer ones had come.
    """

    overall: Percentiles | None
    bins: tuple[LatencyBin, ...]
    stages: dict[str, Percentiles]
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
        latency: null where no answer tells one, and no pair was late.
    """

    hiding: HiddenPairs
    tracking: Tracking | None
    filtering: Filtering | None
    docking: DockingErrors | None
    latency: Latency | None


class SequencesResult(ResultModel):
    """All that is only defined over sequences.

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
