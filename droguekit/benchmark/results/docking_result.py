"""What `benchmark.json` says of the drogue as the probe sees it."""

from __future__ import annotations

from droguekit.benchmark.results.result_parts import ResultModel
from droguekit.benchmark.statistics import Interval


class BodyAxes(ResultModel):
    """One number for each of the receiver's body axes."""

    forward: float
    right: float
    down: float


class Calibration(ResultModel):
    """How often errors stay within what they should; a normal law leaves 68.3 and 95.4 %.

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
        radius_m: that the answers tell, or the drogue's own; each pair is judged by its own, and null where they
            differ. [m]
        true_yes, false_yes, false_no, true_no: whether it was called one, and whether that is true.
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
        mouth_rms_m: of the length of that error; `mouth_interval` by resampled sequences. [m]
        calibration: of each axis.
        closure_n, closure_rmse_m_s, closure_bias_m_s: of the closure where it is known; null without any. [m/s]
        contact_median_absolute_s: size of the error of the time until the rim; null without any. [s]
        miss: against the miss that the true motion of that instant leads to.
        miss_in_the_end: against what the sequence later brought; null where the tip never comes to the rim, or only
            after a gap between pairs.
        captures, captures_in_the_end: of the same two; null where none was told.
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
