"""The filter as navigation uses it: measurements may arrive late, and the state can be asked for at any time."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np

from datasets_manifest.types.estimates import Estimate, Mode, Motion, PoseEstimate
from geometry.se3 import Array, RigidTransform, read_only
from nav.filtering.hypotheses import Bank, Hypothesis, bank_covariance, correct_bank, initial_bank, propagate_bank
from nav.filtering.measurement_update import PoseMeasurement, measurement_from_estimate, pose_difference
from nav.filtering.motion_model import FilterSettings
from nav.pose.pose_method import NoFixReason

FILTER_SUFFIX = "+filter"
_POSE = 6
# Chi-square with 6 degrees of freedom that chance exceeds once in a million; below it two poses of one mode are equal.
_SAME_POSE_CHI2 = 38.3
# Fields of a measured estimate that its filtered estimate takes over.
_MEASURED_FIELDS = ("features", "stage_s", "regions", "latency_s")


@dataclass(frozen=True, eq=False)
class FilterState:
    """Pose and motion of the drogue against the left camera.

    Attributes:
        time_s: time of the state. [s]
        left_from_drogue: pose as the camera sees it; of the equivalent rolls one that is continuous in time.
        velocity_m_s: (3,) of the drogue's origin in the left camera's axes, without vibration. [m/s]
        rate_rad_s: (3,) of its attitude, `R' = [rate]x R`, without vibration. [rad/s]
        covariance: (12, 12) of pose, velocity and rate in this order, in the tangent of
            `datasets_manifest.types.estimates`. [m, rad, m/s, rad/s]
        modes: the poses of all hypotheses, the most likely first.
        motion_known: whether more than one measurement shows the motion; else velocity and rate are those assumed.
    """

    time_s: float
    left_from_drogue: RigidTransform
    velocity_m_s: Array
    rate_rad_s: Array
    covariance: Array
    modes: tuple[Mode, ...] = ()
    motion_known: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity_m_s", read_only(self.velocity_m_s, (3,), "velocity_m_s"))
        object.__setattr__(self, "rate_rad_s", read_only(self.rate_rad_s, (3,), "rate_rad_s"))
        object.__setattr__(self, "covariance", read_only(self.covariance, (12, 12), "covariance"))

    def to_estimate(self, frame_index: int, method: str, measured: Estimate | None = None) -> PoseEstimate:
        """The state as an estimate of a pair, without a motion that is not known.

        Args:
            frame_index: of the pair.
            method: full name, such as `joint-hub+filter`.
            measured: the measured estimate of that pair; its features, regions and times are copied. Its markers are
                numbered by its own roll; `nav.filtering.roll_decoder.with_own_numbers` renumbers them by this one's.
        """
        motion = Motion(
            velocity_m_s=tuple(self.velocity_m_s.tolist()),
            rate_rad_s=tuple(self.rate_rad_s.tolist()),
            covariance=self.covariance[_POSE:, _POSE:],
        )
        estimate = PoseEstimate(
            frame_index=frame_index,
            method=method,
            left_from_drogue=self.left_from_drogue,
            covariance=self.covariance[:_POSE, :_POSE],
            modes=self.modes,
            motion=motion if self.motion_known else None,
        )
        if measured is None:
            return estimate
        return estimate.model_copy(update={name: getattr(measured, name) for name in _MEASURED_FIELDS})


def summarize_bank(bank: Bank, time_s: float, measurements: int) -> FilterState:
    """The most likely hypothesis of so many measurements; its covariance is the mixture's second moment about it."""
    best = bank[0].state
    return FilterState(
        time_s=time_s,
        left_from_drogue=best.pose,
        velocity_m_s=best.velocity_m_s,
        rate_rad_s=best.rate_rad_s,
        covariance=bank_covariance(bank),
        modes=_modes(bank),
        motion_known=measurements > 1,
    )


def _modes(bank: Bank) -> tuple[Mode, ...]:
    """The poses of all hypotheses; those of one measured mode that differ in their motion only share one pose."""
    different: list[tuple[Hypothesis, float]] = []
    for hypothesis in bank:
        same = next((i for i, (other, _) in enumerate(different) if _is_same_pose(other, hypothesis)), None)
        if same is None:
            different.append((hypothesis, hypothesis.weight))
        else:
            different[same] = (different[same][0], different[same][1] + hypothesis.weight)
    ordered = [different[0], *sorted(different[1:], key=lambda each: -each[1])]
    return tuple(
        Mode(left_from_drogue=hypothesis.state.pose, weight=min(weight, 1.0)) for hypothesis, weight in ordered
    )


def _is_same_pose(one: Hypothesis, other: Hypothesis) -> bool:
    if one.mode != other.mode:
        return False
    covariance = sum(each.state.reported_covariance[:_POSE, :_POSE] for each in (one, other))
    difference = pose_difference(one.state.pose, other.state.pose)
    return float(difference @ np.linalg.solve(covariance, difference)) < _SAME_POSE_CHI2


@dataclass(frozen=True, eq=False)
class Track:
    """One motion that measurements agree on.

    Attributes:
        bank: its hypotheses at `time_s`.
        time_s: time of its last measurement. [s]
        measurements: number of measurements in it.
    """

    bank: Bank
    time_s: float
    measurements: int


@dataclass(frozen=True, eq=False)
class TrackerState:
    """All that the filter knows after some measurements.

    Attributes:
        track: the motion that is reported; None before the first measurement.
        rival: a second motion, of the last rejected measurements; None when the last measurement was accepted.
    """

    track: Track | None = None
    rival: Track | None = None


@dataclass(frozen=True, eq=False)
class UpdateResult:
    """Result of updating a `TrackerState` by one measurement.

    Attributes:
        tracker_state: afterwards.
        accepted: whether the measurement belongs to the reported motion.
        starts: whether the reported motion is a new one, which does not continue the one before; its first
            `tracker_state.track.measurements` measurements are this one and those just before it.
        nis: normalised innovation squared against the motion before; None for a first measurement.
        reason: why the measurement did not simply continue the motion; empty when it did.
    """

    tracker_state: TrackerState
    accepted: bool
    starts: bool
    nis: float | None
    reason: str


def update(
    tracker_state: TrackerState,
    time_s: float,
    measurement: PoseMeasurement,
    settings: FilterSettings,
    symmetry_order: int,
) -> UpdateResult:
    """Process one measurement that is not older than the last one.

    A rejected measurement starts a rival motion, or continues it. The rival replaces the reported motion when enough
    consecutive measurements agree with it.

    Args:
        tracker_state: before.
        time_s: of the measurement's images. [s]
        measurement: the measured pose.
        settings: of the filter.
        symmetry_order: of the drogue's markers.
    """
    track = tracker_state.track
    if track is None or time_s - track.time_s > settings.max_coast_s:
        reason = "first fix" if track is None else f"first fix after a gap of {time_s - track.time_s:.3g} s"
        started = TrackerState(_start_track(time_s, measurement, settings))
        return UpdateResult(started, accepted=True, starts=True, nis=None, reason=reason)
    continued, nis = _continue_track(track, time_s, measurement, settings, symmetry_order)
    if continued is not None:
        return UpdateResult(TrackerState(continued), accepted=True, starts=False, nis=nis, reason="")
    rival = None
    if tracker_state.rival is not None:
        rival, _ = _continue_track(tracker_state.rival, time_s, measurement, settings, symmetry_order)
    rival = rival or _start_track(time_s, measurement, settings)
    if rival.measurements >= settings.restart_fixes:
        reason = f"{rival.measurements} rejected fixes in a row agree: started anew with them"
        return UpdateResult(TrackerState(rival), accepted=True, starts=True, nis=nis, reason=reason)
    reason = f"outside the gate: {nis:.4g} for 6 degrees of freedom"
    rejected = replace(tracker_state, rival=rival)
    return UpdateResult(rejected, accepted=False, starts=False, nis=nis, reason=reason)


def predict(tracker_state: TrackerState, time_s: float, settings: FilterSettings) -> FilterState | None:
    """The motion at a time; None before the first measurement, and when the last one is too old."""
    track = tracker_state.track
    coasted_s = -1.0 if track is None else time_s - track.time_s
    if track is None or not 0 <= coasted_s <= settings.max_coast_s:
        return None
    # Most calls ask for the time of the last measurement, which needs no propagation.
    bank = propagate_bank(track.bank, coasted_s, settings) if coasted_s > 0 else track.bank
    return summarize_bank(bank, time_s, track.measurements)


def _start_track(time_s: float, measurement: PoseMeasurement, settings: FilterSettings) -> Track:
    return Track(initial_bank(measurement, settings), time_s, measurements=1)


def _continue_track(
    track: Track, time_s: float, measurement: PoseMeasurement, settings: FilterSettings, symmetry_order: int
) -> tuple[Track | None, float]:
    """The track with one more measurement, None where that is outside the gate; and its chi-square."""
    predicted = propagate_bank(track.bank, time_s - track.time_s, settings, branches=True)
    corrected = correct_bank(predicted, measurement, settings, symmetry_order)
    if corrected.bank is None:
        return None, corrected.nis
    return Track(corrected.bank, time_s, track.measurements + 1), corrected.nis


@dataclass(frozen=True, eq=False)
class FilterUpdate:
    """Result of updating the filter by an estimate.

    Attributes:
        state: at the time of the estimate's images, whether it was accepted or not; None where nothing is known.
        accepted: whether the state uses the estimate.
        nis: normalised innovation squared, chi-square with 6 degrees of freedom; None without a prediction.
        reason: why the estimate did not simply continue the motion; empty when it did.
    """

    state: FilterState | None
    accepted: bool
    nis: float | None
    reason: str


@dataclass(frozen=True, eq=False)
class _Entry:
    """A remembered measurement, and the result of its update."""

    time_s: float
    measurement: PoseMeasurement
    result: UpdateResult


class PoseFilter:
    """Error-state Kalman filter of one drogue's motion against the left camera; see docs/explanation/filtering.md."""

    def __init__(self, settings: FilterSettings, symmetry_order: int) -> None:
        """Create a filter without measurements.

        Args:
            settings: of motion and limits.
            symmetry_order: how many rolls map the drogue's markers onto themselves.

        Raises:
            ValueError: an order below 1.
        """
        if symmetry_order < 1:
            raise ValueError(f"symmetry_order: must be at least 1, got {symmetry_order}")
        self._settings = settings
        self._symmetry_order = symmetry_order
        self.reset()

    def reset(self) -> None:
        """Forget all measurements."""
        self._base = TrackerState()
        self._entries: list[_Entry] = []
        self._too_late = 0

    def predict(self, time_s: float) -> FilterState | None:
        """The state at a time; does not change the filter.

        Args:
            time_s: any time; a past one is answered from the measurements up to it, as far as they are remembered. [s]

        Returns:
            None before the first measurement, and where the last one is older than `max_coast_s`.

        Raises:
            ValueError: a time that is not finite.
        """
        _check_time(time_s)
        return predict(self._tracker_state_at(self._count_until(time_s)), time_s, self._settings)

    def update(self, time_s: float, estimate: PoseEstimate) -> FilterUpdate:
        """Update the filter by an estimate.

        A late estimate is inserted at its time, and the updates after it are repeated. One that is older than the
        newest by more than `max_delay_s` is refused, and so is a second one of the same time, which would count twice.

        Args:
            time_s: when its images were taken. [s]
            estimate: the pose, with a covariance.

        Raises:
            ValueError: a time that is not finite.
        """
        _check_time(time_s)
        measurement = measurement_from_estimate(estimate, self._symmetry_order, self._settings.least_weight)
        if isinstance(measurement, NoFixReason):
            return self._refused(time_s, measurement.reason)
        reason = self._lateness_fault(time_s)
        if reason:
            return self._refused(time_s, reason)
        index = self._count_until(time_s)
        if index and self._entries[index - 1].time_s == time_s:
            return self._refused(time_s, f"there is a fix of {time_s:.6g} s already")
        later = [(entry.time_s, entry.measurement) for entry in self._entries[index:]]
        del self._entries[index:]
        for entry_time_s, each in [(time_s, measurement), *later]:
            before = self._tracker_state_at(len(self._entries))
            result = update(before, entry_time_s, each, self._settings, self._symmetry_order)
            self._entries.append(_Entry(entry_time_s, each, result))
        result = self._entries[index].result
        state = predict(result.tracker_state, time_s, self._settings)
        self._forget()
        return FilterUpdate(state, result.accepted, result.nis, result.reason)

    def _refused(self, time_s: float, reason: str) -> FilterUpdate:
        return FilterUpdate(self.predict(time_s), accepted=False, nis=None, reason=reason)

    def _lateness_fault(self, time_s: float) -> str:
        """Why a measurement is too late; empty where it is not.

        Several late ones in a row mean that the clock was set back, or set right: the filter then starts anew.
        """
        late_s = self._entries[-1].time_s - time_s if self._entries else 0.0
        if late_s <= self._settings.max_delay_s:
            self._too_late = 0
            return ""
        self._too_late += 1
        if self._too_late < self._settings.restart_fixes:
            return f"came too late: {late_s:.3g} s older than the newest fix"
        self.reset()
        return ""

    def _count_until(self, time_s: float) -> int:
        """How many remembered measurements are not later than a time."""
        return bisect_right(self._entries, time_s, key=lambda entry: entry.time_s)

    def _tracker_state_at(self, count: int) -> TrackerState:
        """State after the first remembered measurements."""
        return self._entries[count - 1].result.tracker_state if count else self._base

    def _forget(self) -> None:
        """Drop the measurements that no late one can precede."""
        oldest_s = self._entries[-1].time_s - self._settings.max_delay_s
        dropped = max(self._count_until(oldest_s) - 1, 0)
        if dropped:
            self._base = self._entries[dropped - 1].result.tracker_state
            del self._entries[:dropped]


def _check_time(time_s: float) -> None:
    if not np.isfinite(time_s):
        raise ValueError(f"time_s: must be finite, got {time_s}")
