"""Parts of the rows of `benchmark.json`."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from droguekit.scoring.confidence_intervals import Interval


class ResultModel(BaseModel):
    """A part of the result; numbers are finite, undefined values are null."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)


class ComponentRatios(ResultModel):
    """One number for each component of the pose."""

    x: float
    y: float
    z: float
    pitch: float
    yaw: float


class Bound(ResultModel):
    """Cramer-Rao bound, as root mean square over frames."""

    position_m: float
    x_m: float
    y_m: float
    z_m: float
    pitch_deg: float
    yaw_deg: float


class CentroidStatistics(ResultModel):
    """Measured minus true ellipse centres of many features.

    Attributes:
        count: how many marker centroids.
        sigma_px: root mean square error of the markers' coordinates, None without any. [px]
        bias_u_px, bias_v_px: mean errors to the right and down. [px]
        bias_outward_px: mean error away from the drogue's middle. [px]
        hub_count, hub_sigma_px: the same of the hub.
        mistaken: number of measurements that belong to something else.
    """

    count: int
    sigma_px: float | None
    bias_u_px: float | None
    bias_v_px: float | None
    bias_outward_px: float | None
    hub_count: int
    hub_sigma_px: float | None
    mistaken: int


class ComponentErrors(ResultModel):
    """One error for each component of the pose."""

    x_m: float
    y_m: float
    z_m: float
    pitch_deg: float
    yaw_deg: float


class NormalizedErrors(ResultModel):
    """Root mean square of errors over the bound of their frame; 1 is what physics allows.

    Attributes:
        n: poses in frames that have a bound.
        nrms: by component.
        upper: one-sided 95 % upper limit of each, `nrms sqrt(n / chi2_{0.05, n})`.
    """

    n: int
    nrms: ComponentRatios
    upper: ComponentRatios


class NeesPart(ResultModel):
    """Normalized estimation error squared, over its degrees of freedom; 1 for true covariances.

    Attributes:
        freedom: degrees of freedom of one pose.
        per_freedom: mean over the poses.
        low, high: where 95 % of such means lie for true covariances, by the chi-square law.
    """

    freedom: int
    per_freedom: float
    low: float
    high: float


class Nees(ResultModel):
    """How well the errors fit the reported covariances.

    Attributes:
        n: poses with a covariance that counts.
        unusable: poses whose covariance is not positive definite, or in a tangent that is not ours.
        position: of X, Y, Z.
        attitude: of pitch and yaw.
        pose: of all five. Roll is marginalised in all of them.
    """

    n: int
    unusable: int
    position: NeesPart | None
    attitude: NeesPart | None
    pose: NeesPart | None


class Flips(ResultModel):
    """Tilts that came out mirrored, among the poses whose true tilt exceeds five times its bound.

    Attributes:
        n: how many poses that is.
        flips, rate, interval: how many of them were mirrored; their share and its Wilson interval.
        predicted: share that the flip law expects at the method's own noise; null where the law does not hold, as for
            a method that uses the hub or one eye.
    """

    n: int
    flips: int
    rate: float | None
    interval: Interval | None
    predicted: float | None


class DepthErrors(ResultModel):
    """Errors in depth over some pairs.

    Attributes:
        bias_m, rmse_m: mean and root mean square. [m]
        mean_absolute_m, mean_absolute_fraction: mean size, and that over the depth it is compared with. [m]
    """

    bias_m: float
    rmse_m: float
    mean_absolute_m: float
    mean_absolute_fraction: float


class RangefinderErrors(ResultModel):
    """Depth errors of an experiment that takes a rangefinder's reading for the truth.

    Attributes:
        n: pairs with a pose and a reading.
        against_reading: estimate minus reading, which such an experiment would report.
        against_truth: estimate minus truth, over the same pairs.
        reading: reading minus truth, over the same pairs.
    """

    n: int
    against_reading: DepthErrors
    against_truth: DepthErrors
    reading: DepthErrors


class MeanRatios(ResultModel):
    """Mean error of one method over that of another, over the pairs in which both found a pose.

    Attributes:
        n: how many pairs.
        blocks: number of resampled units: sequences, or pairs that belong to none.
        position: of the lengths of the position errors; null where the other's mean is zero, or n is.
        attitude: of the sizes of pitch and yaw errors together.
        position_interval, attitude_interval: 95 %, by bootstrap; null with fewer than two blocks.
    """

    n: int
    blocks: int
    position: float | None
    position_interval: Interval | None
    attitude: float | None
    attitude_interval: Interval | None


class BinRatios(MeanRatios):
    """Ratios over the distances from `low_m` to `high_m`. [m]"""

    low_m: float
    high_m: float


class MethodComparison(ResultModel):
    """One method compared with another on the same pairs."""

    method: str
    against: str
    overall: MeanRatios
    bins: list[BinRatios]
