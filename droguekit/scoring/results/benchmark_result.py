"""The types of `benchmark.json`."""

from __future__ import annotations

import json
from typing import Any, Literal

from pydantic import Field, model_serializer

from droguekit.scoring.confidence_intervals import Interval
from droguekit.scoring.results.pose_result import (
    Bound,
    CentroidStatistics,
    ComponentErrors,
    ComponentRatios,
    Flips,
    MethodComparison,
    Nees,
    NormalizedErrors,
    RangefinderErrors,
    ResultModel,
)
from droguekit.scoring.results.sequence_result import SequencesResult


class PoseRow(ResultModel):
    """One method over a set of frames: estimate minus truth, over the frames with a fix. All null without a fix.

    Attributes:
        n: pairs that show a drogue.
        fixes: of these, pairs with a pose.
        position_*: length of the position error. [m]
        transverse_*: its part across the line of sight. [m]
        x_*, y_*, z_*: in the left camera. [m]
        pitch_*, yaw_*: of the drogue's axis. [deg]
        *_p95, *_p99, *_max: of the error's absolute value; *_bias: its mean.
        intervals: 95 % confidence interval by the name of the key it belongs to.
        bound: at the measured noise of the file's best centroids, over the frames with a fix whose features determine a
            pose. Null where there is none.
        bound_ratio: root mean square error over the bound, of the same frames.
        centroids: of this method's own features.
        position_from_centroids_rmse_m: position error that least squares would have with these centroids. [m]
        centroid_share: share of the mean squared position error that this explains, in [0, 1]; the rest is the
            method's own.
        normalized: errors over the bound of their own frame, of all visible features, markers and hub each at the
            noise of the best centroids in the file.
        normalized_own: the same over the bound of the features that the method itself used, at its own noise.
        nees: how well the errors fit the covariances that the method reports; null without any.
        flips: tilts that came out mirrored, as seen along the optical axis.
        sight_flips: the same as seen along the line of sight, about which the mirror really lies.
        failures: pairs without a pose.
        rmse_with_failures: root mean square errors over all n pairs, where a pair without a pose counts with the
            standard deviation of the true poses of the dataset.
        rangefinder: depths against the readings of a rangefinder; null without any.
    """

    n: int
    fixes: int
    fix_fraction: float
    position_mean_m: float | None = None
    position_rmse_m: float | None = None
    position_p95_m: float | None = None
    position_p99_m: float | None = None
    position_max_m: float | None = None
    x_rmse_m: float | None = None
    y_rmse_m: float | None = None
    z_rmse_m: float | None = None
    transverse_rmse_m: float | None = None
    x_bias_m: float | None = None
    y_bias_m: float | None = None
    z_bias_m: float | None = None
    x_p95_m: float | None = None
    y_p95_m: float | None = None
    z_p95_m: float | None = None
    x_p99_m: float | None = None
    y_p99_m: float | None = None
    z_p99_m: float | None = None
    x_max_m: float | None = None
    y_max_m: float | None = None
    z_max_m: float | None = None
    pitch_rmse_deg: float | None = None
    yaw_rmse_deg: float | None = None
    pitch_bias_deg: float | None = None
    yaw_bias_deg: float | None = None
    pitch_p95_deg: float | None = None
    yaw_p95_deg: float | None = None
    pitch_p99_deg: float | None = None
    yaw_p99_deg: float | None = None
    pitch_max_deg: float | None = None
    yaw_max_deg: float | None = None
    intervals: dict[str, Interval]
    bound: Bound | None
    bound_ratio: ComponentRatios | None
    centroids: CentroidStatistics
    position_from_centroids_rmse_m: float | None
    centroid_share: float | None
    normalized: NormalizedErrors | None
    normalized_own: NormalizedErrors | None
    nees: Nees | None
    flips: Flips
    sight_flips: Flips
    failures: int
    rmse_with_failures: ComponentErrors
    rangefinder: RangefinderErrors | None = None

    def value(self, key: str) -> float | None:
        """The number of that name.

        Raises:
            KeyError: there is no such number.
        """
        if key not in type(self).model_fields:
            raise KeyError(key)
        number: float | None = getattr(self, key)
        return number


class PoseBin(PoseRow):
    """A row of the distances from `low_m` to `high_m`. [m]"""

    low_m: float
    high_m: float


class EmptyFrames(ResultModel):
    """Pairs without a drogue, where any fix is a false one."""

    n: int
    false_fixes: int
    false_fix_fraction: float | None
    interval: Interval | None


class MethodResult(ResultModel):
    """One method: all frames, then by distance."""

    overall: PoseRow
    bins: list[PoseBin]
    empty_frames: EmptyFrames


class ReferenceBin(ResultModel):
    """Reference noise and bound at these distances.

    Attributes:
        n: pairs that show a drogue.
        centroid_sigma_px: noise of the best centroids in the file, null without any. [px]
        centroid_method: whose they are.
        hub_sigma_px, hub_method: the same of the hub.
        bound: at that noise, over all pairs of the bin whose features determine a pose.
    """

    low_m: float
    high_m: float
    n: int
    centroid_sigma_px: float | None
    centroid_method: str | None
    hub_sigma_px: float | None
    hub_method: str | None
    bound: Bound | None


class DatasetFacts(ResultModel):
    """The dataset that was scored on."""

    name: str
    sha256: str
    pairs: int


class BenchmarkResult(ResultModel):
    """Everything that `benchmark.json` holds.

    Attributes:
        sequences: left out where the dataset has none, or no estimate has regions, motion, docking quantities or times.
    """

    schema_version: Literal[1] = Field(default=1, alias="schema")
    dataset: DatasetFacts
    code_version: str
    confidence: float
    reference: list[ReferenceBin]
    methods: dict[str, MethodResult]
    comparisons: list[MethodComparison]
    sequences: SequencesResult | None = None

    @model_serializer(mode="plain")
    def _with_schema(self) -> dict[str, Any]:
        """`schema` is the key on disk, but the name of a method of every pydantic model."""
        fields = {name: getattr(self, name) for name in type(self).model_fields}
        if self.sequences is None:
            del fields["sequences"]
        return {"schema" if name == "schema_version" else name: value for name, value in fields.items()}

    def to_json(self) -> str:
        """The text of `benchmark.json`, indented."""
        return json.dumps(self.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"
