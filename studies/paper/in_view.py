"""Scores over the pairs in which a pose can be asked for: enough markers and the hub are seen by both eyes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from datasets_manifest.types.records import PairRecord, ViewRecord
from droguekit.benchmark.poses.frame_truth import VISIBLE_FRACTION
from droguekit.benchmark.statistics import Interval, bootstrap_intervals
from geometry.se3 import Array

LEAST_MARKERS = 4


@dataclass(frozen=True, eq=False)
class ChosenScores:
    """A method over some pairs; errors are over those with a pose, and None without any.

    Attributes:
        fix_fraction: pairs with a pose.
        mean_m, interval_m, p99_m: of the length of the position error. [m]
        largest_m: (3,) in X, Y, Z. [m]
        angles_p99_deg: (2,) of pitch and yaw. [deg]
    """

    fix_fraction: float
    mean_m: float | None = None
    interval_m: Interval | None = None
    p99_m: float | None = None
    largest_m: Array | None = None
    angles_p99_deg: Array | None = None


def frames_in_view(records: Mapping[int, PairRecord]) -> list[int]:
    """Pairs of which both eyes see at least four markers and the hub: wholly on the image, at most a tenth hidden."""
    return [
        index
        for index, record in records.items()
        if all(_is_enough(view) for view in (record.views.left, record.views.right))
    ]


def chosen_scores(errors: Mapping[int, Array], frames: Sequence[int], key: str) -> ChosenScores:
    """Scores over some pairs, of which there is at least one.

    Args:
        errors: (5,) X, Y, Z [m], pitch, yaw [deg] by frame, where there is a pose.
        frames: which pairs count.
        key: of the bootstrap's random stream.
    """
    rows = np.array([errors[index] for index in frames if index in errors])
    if not len(rows):
        return ChosenScores(0.0)
    lengths = np.linalg.norm(rows[:, :3], axis=1)
    means, _ = bootstrap_intervals(lengths[:, None], (99.0,), key)
    sizes = np.abs(rows)
    return ChosenScores(
        fix_fraction=len(rows) / len(frames),
        mean_m=float(lengths.mean()),
        interval_m=(float(means[0, 0]), float(means[0, 1])),
        p99_m=float(np.percentile(lengths, 99.0)),
        largest_m=sizes[:, :3].max(axis=0),
        angles_p99_deg=np.percentile(sizes[:, 3:], 99.0, axis=0),
    )


def _is_enough(view: ViewRecord) -> bool:
    seen = sum(marker.in_image and marker.visible_fraction >= VISIBLE_FRACTION for marker in view.markers)
    hub = view.hub
    return seen >= LEAST_MARKERS and hub is not None and hub.in_image and hub.visible_fraction >= VISIBLE_FRACTION
