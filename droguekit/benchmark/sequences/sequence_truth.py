"""What scoring needs of the records of a sequence: when each pair was taken, where the drogue was, and who saw it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from datasets_manifest.types.records import PairRecord, PixelBox
from drogue_models.parameters import DrogueParameters
from droguekit.benchmark.poses.visibility import LEAST_SEEN_FRACTION, seen_fraction
from geometry.se3 import Array, RigidTransform
from geometry.stereo import EYES, Eye, StereoRig

Sight = Literal["seen", "partly", "hidden", "dazzled"]
"""`seen`: enough of the drogue to be found; `hidden`: nothing of it, or of none of its markers; `dazzled`: the sun in
the lens may or may not outshine it, so that neither answer is wrong."""

# A pair that comes later than this many periods follows a gap.
_GAP_PERIODS = 1.5


@dataclass(frozen=True)
class EyeTruth:
    """The drogue in one image.

    Attributes:
        box_px: around its visible pixels, in pixel-centre coordinates; None where there are none. [px]
        seen_fraction: see `visibility.seen_fraction`.
        is_dazzled: the sequence has the sun beside the drogue just now.
    """

    box_px: PixelBox | None
    seen_fraction: float
    is_dazzled: bool

    @property
    def sight(self) -> Sight:
        """Whether it is to be found there."""
        if self.seen_fraction == 0:
            return "hidden"
        if self.is_dazzled:
            return "dazzled"
        return "seen" if self.seen_fraction >= LEAST_SEEN_FRACTION else "partly"


@dataclass(frozen=True, eq=False)
class Moment:
    """One pair of a sequence.

    Attributes:
        frame_index, sequence_id, time_s: which pair, and the middle of its exposure.
        rig: the cameras and the probe.
        drogue: None without one.
        left_from_drogue: None without a drogue.
        instant_velocity_m_s: of the drogue's origin in the left camera at that instant, vibration included; None
            without a drogue. [m/s]
        eyes: what each image shows.
    """

    frame_index: int
    sequence_id: int
    time_s: float
    rig: StereoRig
    drogue: DrogueParameters | None
    left_from_drogue: RigidTransform | None
    instant_velocity_m_s: Array | None
    eyes: Mapping[Eye, EyeTruth]

    @property
    def sight(self) -> Sight:
        """Of the pair: that of both images, or `partly` where they differ."""
        sights = {eye.sight for eye in self.eyes.values()}
        return sights.pop() if len(sights) == 1 else "partly"


@dataclass(frozen=True, eq=False)
class TrueSequence:
    """Two or more pairs that follow each other.

    Attributes:
        sequence_id: its number.
        period_s: median time from one pair to the next, the lesser one of two. [s]
        moments: by ascending time.
    """

    sequence_id: int
    period_s: float
    moments: tuple[Moment, ...]

    def runs(self) -> Iterator[tuple[Moment, ...]]:
        """The pairs with a drogue that follow each other without a gap."""
        run: list[Moment] = []
        for moment in self.moments:
            gap = run and moment.time_s - run[-1].time_s > _GAP_PERIODS * self.period_s
            if run and (gap or moment.left_from_drogue is None):
                yield tuple(run)
                run = []
            if moment.left_from_drogue is not None:
                run.append(moment)
        if run:
            yield tuple(run)


def moment(record: PairRecord) -> Moment | None:
    """A record as a moment of its sequence; None where it belongs to none."""
    if record.sequence_id is None:
        return None
    frame, pose, velocity = record.frame, record.left_from_drogue, None
    if pose is not None:
        camera, drogue = frame.left_twist_per_s, frame.drogue_twist_per_s
        # Derivative of `FrameSpec.left_from_drogue_at` at mid-exposure.
        velocity = pose.rotate(drogue[:3]) - camera[:3] - np.cross(camera[3:], pose.translation_m)
    views = dict(zip(EYES, (record.views.left, record.views.right), strict=True))
    return Moment(
        frame_index=record.frame_index,
        sequence_id=record.sequence_id,
        time_s=record.time_s,
        rig=frame.rig,
        drogue=frame.drogue,
        left_from_drogue=pose,
        instant_velocity_m_s=velocity,
        eyes={
            eye: EyeTruth(view.box_visible_xywh_px, seen_fraction(record, eye), frame.loss == "glare")
            for eye, view in views.items()
        },
    )


def true_sequences(moments: Iterable[Moment | None]) -> tuple[TrueSequence, ...]:
    """The sequences of a dataset by their numbers; single pairs are left out.

    Raises:
        ValueError: two pairs of a sequence have one time.
    """
    by_id: dict[int, list[Moment]] = {}
    for one in moments:
        if one is not None:
            by_id.setdefault(one.sequence_id, []).append(one)
    return tuple(_sequence(number, by_id[number]) for number in sorted(by_id) if len(by_id[number]) > 1)


def _sequence(number: int, moments: list[Moment]) -> TrueSequence:
    ordered = sorted(moments, key=lambda one: one.time_s)
    steps = np.diff([one.time_s for one in ordered])
    if not (steps > 0).all():
        at = ordered[int(np.argmin(steps))].frame_index
        raise ValueError(f"frame {at}: time_s: must differ from that of the next pair of sequence {number}")
    # A mean of two steps is the length of neither, where one of them is a gap.
    return TrueSequence(number, float(np.percentile(steps, 50, method="lower")), tuple(ordered))
