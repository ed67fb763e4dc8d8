"""The filter as navigation uses it: measurements may arrive late, and the state can be asked for at any time."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np

from datasets_manifest.types.estimates import Estimate, Mode, Motion, PoseEstimate
from geometry.se3 import Array, RigidTransform, read_only
from nav.filtering.hypotheses import Bank, Hypothesis, advance_bank, bank_covariance, correct_bank, first_bank
from nav.filtering.measurement_update import Fix, fix_of, pose_difference
from nav.filtering.motion_model import FilterSettings
from nav.pose.pose_method import NoFixReason

_POSE = 6
# Chi-square below which two poses are one fix of the same mode; six degrees of freedom, beyond it one of a million.
_SAME_POSE = 38.3
# What of a measured estimate does not change when it is filtered.
_MEASURED = ("features", "stage_s", "regions", "latency_s")


@dataclass(frozen=True, eq=False)
class FilterState:
    """Pose and motion of the drogue against the left camera.

    Attributes:
        time_s: when. [s]
        left_from_drogue: pose as the camera sees it; of the equivalent rolls one that goes on from fix to fix.
        velocity_m_s: (3,) of the drogue's origin in the left camera's axes, without its vibration. [m/s]
        rate_rad_s: (3,) of its attitude, `R' = [rate]x R`, without its vibration. [rad/s]
        covariance: (12, 12) of pose, velocity and rate in this order, in the tangent of
            `datasets_manifest.types.estimates`. [m, rad, m/s, rad/s]
        modes: the poses of all explanations that live, the best first.
        coasted_s: since the last fix. [s]
    """

    time_s: float
    left_from_drogue: RigidTransform
    velocity_m_s: Array
    rate_rad_s: Array
    covariance: Array
    modes: tuple[Mode, ...] = ()
    coasted_s: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity_m_s", read_only(self.velocity_m_s, (3,), "velocity_m_s"))
        object.__setattr__(self, "rate_rad_s", read_only(self.rate_rad_s, (3,), "rate_rad_s"))
        object.__setattr__(self, "covariance", read_only(self.covariance, (12, 12), "covariance"))

    def to_estimate(self, frame_index: int, method: str, measured: Estimate | None = None) -> PoseEstimate:
        """As an ordinary estimate.

        Args:
            frame_index: of the pair that it is for.
            method: full name, such as `joint-hub+filter`.
            measured: what was measured in that pair; its features, regions and times go along.
        """
        estimate = PoseEstimate(
            frame_index=frame_index,
            method=method,
            left_from_drogue=self.left_from_drogue,
            covariance=self.covariance[:_POSE, :_POSE],
            modes=self.modes,
            motion=Motion(
                velocity_m_s=tuple(self.velocity_m_s.tolist()),
                rate_rad_s=tuple(self.rate_rad_s.tolist()),
                covariance=self.covariance[_POSE:, _POSE:],
            ),
        )
        if measured is None:
            return estimate
        return estimate.model_copy(update={name: getattr(measured, name) for name in _MEASURED})


def state_of(bank: Bank, time_s: float, coasted_s: float) -> FilterState:
    """The best hypothesis, with a covariance that covers all."""
    best = bank[0].state
    return FilterState(
        time_s=time_s,
        left_from_drogue=best.pose,
        velocity_m_s=best.velocity_m_s,
        rate_rad_s=best.rate_rad_s,
        covariance=bank_covariance(bank),
        modes=_modes(bank),
        coasted_s=coasted_s,
    )


def _modes(bank: Bank) -> tuple[Mode, ...]:
    """The poses of all explanations; those of one mode of the last fix that differ in their motion alone share one."""
    different: list[tuple[Hypothesis, float]] = []
    for one in bank:
        same = next((at for at, (other, _) in enumerate(different) if _is_same_pose(other, one)), None)
        if same is None:
            different.append((one, one.weight))
        else:
            different[same] = (different[same][0], different[same][1] + one.weight)
    ordered = [different[0], *sorted(different[1:], key=lambda each: -each[1])]
    return tuple(Mode(left_from_drogue=one.state.pose, weight=min(weight, 1.0)) for one, weight in ordered)


def _is_same_pose(one: Hypothesis, other: Hypothesis) -> bool:
    if one.mode != other.mode:
        return False
    covariance = sum(each.state.told_covariance[:_POSE, :_POSE] for each in (one, other))
    away = pose_difference(one.state.pose, other.state.pose)
    return float(away @ np.linalg.solve(covariance, away)) < _SAME_POSE


@dataclass(frozen=True, eq=False)
class Track:
    """One motion.

    Attributes:
        bank: its explanations at `time_s`, the time of its last fix.
        time_s: [s]
        fixes: how many it rests on.
    """

    bank: Bank
    time_s: float
    fixes: int


@dataclass(frozen=True, eq=False)
class Memory:
    """All that a filter knows after some fixes; it never changes.

    Attributes:
        track: the motion that is told; None before the first fix.
        rival: what the last rejected fixes agree on; None when the last fix was accepted.
    """

    track: Track | None = None
    rival: Track | None = None


@dataclass(frozen=True, eq=False)
class Taken:
    """What became of a fix.

    Attributes:
        memory: afterwards.
        accepted: whether the told motion rests on it.
        starts: whether a motion is told from here on that does not go on from the one before; its first
            `memory.track.fixes` fixes are this one and those just before it.
        nis: its chi-square against the motion so far; None for a first fix.
        reason: why it was not simply taken; empty when it was.
    """

    memory: Memory
    accepted: bool
    starts: bool
    nis: float | None
    reason: str


def take(memory: Memory, time_s: float, fix: Fix, settings: FilterSettings, symmetry_order: int) -> Taken:
    """Take one fix that is no older than the last one.

    Args:
        memory: so far.
        time_s: of the fix's images. [s]
        fix: what was measured.
        settings: of the filter.
        symmetry_order: of the drogue's markers.
    """
    track = memory.track
    if track is None or time_s - track.time_s > settings.max_coast_s:
        reason = "first fix" if track is None else f"first fix after a gap of {time_s - track.time_s:.3g} s"
        return Taken(Memory(_started(time_s, fix, settings)), True, True, None, reason)
    followed, nis = _followed(track, time_s, fix, settings, symmetry_order)
    if followed is not None:
        return Taken(Memory(followed), True, False, nis, "")
    rival = None
    if memory.rival is not None:
        rival, _ = _followed(memory.rival, time_s, fix, settings, symmetry_order)
    rival = rival or _started(time_s, fix, settings)
    if rival.fixes >= settings.restart_fixes:
        reason = f"{rival.fixes} rejected fixes in a row agree: started anew with them"
        return Taken(Memory(rival), True, True, nis, reason)
    reason = f"outside the gate: {nis:.4g} for 6 degrees of freedom"
    return Taken(replace(memory, rival=rival), False, False, nis, reason)


def told(memory: Memory, time_s: float, settings: FilterSettings) -> FilterState | None:
    """The motion at a time; None before the first fix, and when the last one is too old."""
    track = memory.track
    coasted_s = -1.0 if track is None else time_s - track.time_s
    if track is None or not 0 <= coasted_s <= settings.max_coast_s:
        return None
    # Right after a fix, which is when most ask, there is nowhere to go on to.
    bank = advance_bank(track.bank, coasted_s, settings) if coasted_s > 0 else track.bank
    return state_of(bank, time_s, coasted_s)


def _started(time_s: float, fix: Fix, settings: FilterSettings) -> Track:
    return Track(first_bank(fix, settings), time_s, 1)


def _followed(
    track: Track, time_s: float, fix: Fix, settings: FilterSettings, symmetry_order: int
) -> tuple[Track | None, float]:
    """The track with one more fix, None where the fix does not fit; and its chi-square."""
    predicted = advance_bank(track.bank, time_s - track.time_s, settings, branches=True)
    update = correct_bank(predicted, fix, settings, symmetry_order)
    return (None if update.bank is None else Track(update.bank, time_s, track.fixes + 1)), update.nis


FILTER_SUFFIX = "+filter"


@dataclass(frozen=True, eq=False)
class FilterUpdate:
    """What became of an estimate.

    Attributes:
        state: at the time of its images, whether it was accepted or not; None where nothing is known.
        accepted: whether the state rests on it.
        nis: its normalised innovation squared, chi-square with 6 degrees of freedom; None where nothing was predicted.
        reason: why it was not simply taken; empty when it was.
    """

    state: FilterState | None
    accepted: bool
    nis: float | None
    reason: str


@dataclass(frozen=True, eq=False)
class _Entry:
    """A fix, and the memory after it."""

    time_s: float
    fix: Fix
    taken: Taken


class PoseFilter:
    """Error-state Kalman filter of one drogue's motion against the left camera; see docs/explanation/filtering.md."""

    def __init__(self, settings: FilterSettings, symmetry_order: int) -> None:
        """Begin with nothing.

        Args:
            settings: of motion and limits.
            symmetry_order: how many turns about its axis map the drogue's markers onto themselves.

        Raises:
            ValueError: an order below 1.
        """
        if symmetry_order < 1:
            raise ValueError(f"symmetry_order: must be at least 1, got {symmetry_order}")
        self._settings = settings
        self._symmetry_order = symmetry_order
        self.reset()

    def reset(self) -> None:
        """Forget all fixes."""
        self._base = Memory()
        self._entries: list[_Entry] = []
        self._too_late = 0

    def predict(self, time_s: float) -> FilterState | None:
        """The state at a time; the filter's memory does not change.

        Args:
            time_s: any; a past one is answered from the fixes up to it, as far as they are remembered. [s]

        Returns:
            None before the first fix, and where the last one is older than `max_coast_s`.

        Raises:
            ValueError: a time that is not finite.
        """
        _check_time(time_s)
        return told(self._memory_before(self._place(time_s)), time_s, self._settings)

    def update(self, time_s: float, estimate: PoseEstimate) -> FilterUpdate:
        """Learn from an estimate.

        One that is older than others is put in its place, and the later ones are taken again after it; one that is
        older than the newest by more than `max_delay_s` is refused, and so is another one of the same time: what comes
        twice would count twice.

        Args:
            time_s: when its images were taken. [s]
            estimate: the pose, with a covariance.

        Raises:
            ValueError: a time that is not finite.
        """
        _check_time(time_s)
        fix = fix_of(estimate, self._symmetry_order, self._settings.least_weight)
        if isinstance(fix, NoFixReason):
            return FilterUpdate(self.predict(time_s), False, None, fix.reason)
        reason = self._refusal(time_s)
        if reason:
            return FilterUpdate(self.predict(time_s), False, None, reason)
        place = self._place(time_s)
        if place and self._entries[place - 1].time_s == time_s:
            return FilterUpdate(self.predict(time_s), False, None, f"there is a fix of {time_s:.6g} s already")
        later = [(entry.time_s, entry.fix) for entry in self._entries[place:]]
        del self._entries[place:]
        for fix_time_s, each in [(time_s, fix), *later]:
            before = self._memory_before(len(self._entries))
            taken = take(before, fix_time_s, each, self._settings, self._symmetry_order)
            self._entries.append(_Entry(fix_time_s, each, taken))
        taken = self._entries[place].taken
        state = told(taken.memory, time_s, self._settings)
        self._forget()
        return FilterUpdate(state, taken.accepted, taken.nis, taken.reason)

    def _refusal(self, time_s: float) -> str:
        """Why a fix comes too late; empty where it does not.

        Several in a row that do are of a clock that was set back, or set right: then all before is forgotten.
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

    def _place(self, time_s: float) -> int:
        """How many remembered fixes are not later than a time."""
        return bisect_right(self._entries, time_s, key=lambda entry: entry.time_s)

    def _memory_before(self, place: int) -> Memory:
        return self._entries[place - 1].taken.memory if place else self._base

    def _forget(self) -> None:
        """Keep the fixes that a late one may still come before."""
        oldest_s = self._entries[-1].time_s - self._settings.max_delay_s
        gone = max(self._place(oldest_s) - 1, 0)
        if gone:
            self._base = self._entries[gone - 1].taken.memory
            del self._entries[:gone]


def _check_time(time_s: float) -> None:
    if not np.isfinite(time_s):
        raise ValueError(f"time_s: must be finite, got {time_s}")
