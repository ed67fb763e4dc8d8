"""The filter as navigation uses it: fixes come at any time, late ones too, and any time may be asked for."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.estimates import PoseEstimate
from nav.filtering.filter_settings import FilterSettings
from nav.filtering.filter_state import FilterState
from nav.filtering.pose_measurement import Fix, fix_of
from nav.filtering.track import Memory, Taken, take, told
from nav.pose.pose_method import NoFixReason

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
