"""Fixes in the order of their times: the motion that is followed, and a rival that rejected fixes agree on."""

from __future__ import annotations

from dataclasses import dataclass, replace

from nav.filtering.filter_settings import FilterSettings
from nav.filtering.filter_state import FilterState, state_of
from nav.filtering.hypotheses import Bank, advance_bank, correct_bank, first_bank
from nav.filtering.pose_measurement import Fix


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
