"""Whether navigation errs alike on two engines' images of the same poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import t

from droguekit.benchmark.poses.pose_errors import COMPONENTS
from droguekit.benchmark.statistics import CONFIDENCE, Interval, ratio_intervals
from geometry.se3 import Array


@dataclass(frozen=True, eq=False)
class PairedErrors:
    """Errors in the pairs of one distance for which both engines' images gave a pose.

    Attributes:
        distance_m: of the drogue. [m]
        pairs: rendered.
        one, other: (n, 5) errors of X, Y, Z [m], pitch and yaw [deg] by either engine.
    """

    distance_m: float
    pairs: int
    one: Array
    other: Array


@dataclass(frozen=True)
class SizeRatio:
    """Root mean square error by the second engine over that by the first, in the same pairs.

    Attributes:
        of: what errors.
        n: pairs.
        ratio: of the root mean squares, each distance weighing the same.
        interval: of 95 %, from resampled pairs; None with fewer than two.
    """

    of: str
    n: int
    ratio: float
    interval: Interval | None

    @property
    def outside(self) -> float:
        """How far 1 lies outside the interval."""
        low, high = self.interval or (self.ratio, self.ratio)
        return max(low - 1.0, 1.0 - high, 0.0)


@dataclass(frozen=True)
class MeanDifference:
    """Mean of the differences of the engines' errors in one component.

    Attributes:
        of: the component.
        mean: second engine less the first, in units of their root mean square error at each distance.
        reach: half the interval of 95 % for all five components together.
    """

    of: str
    mean: float
    reach: float


def size_ratios(stations: Sequence[PairedErrors]) -> list[SizeRatio]:
    """Sizes of position and attitude errors by the second engine over those by the first.

    Args:
        stations: of different distances, whose errors are taken in units of their own root mean square.
    """
    one, other = (_squares(stations, which) for which in ("one", "other"))
    blocks = list(range(len(one)))
    ends = ratio_intervals(other, one, blocks, "engines, joint errors")
    rows = []
    for column, name in enumerate(("position", "attitude")):
        ratio = float(np.sqrt(other[:, column].sum() / one[:, column].sum()))
        interval = ends[column]
        rows.append(
            SizeRatio(
                name,
                len(one),
                ratio,
                None if interval is None else (float(np.sqrt(interval[0])), float(np.sqrt(interval[1]))),
            )
        )
    return rows


def mean_differences(stations: Sequence[PairedErrors]) -> list[MeanDifference]:
    """Whether one engine's images pull the poses to a side, by component."""
    scaled = np.concatenate([(s.other - s.one) / _root_mean_square(s) for s in stations])
    count, components = scaled.shape
    # Bonferroni: all components together stay inside with 95 %.
    reach = t.ppf(1 - (1 - CONFIDENCE) / 2 / components, count - 1) * scaled.std(axis=0, ddof=1) / np.sqrt(count)
    means = scaled.mean(axis=0)
    return [MeanDifference(name, float(means[i]), float(reach[i])) for i, name in enumerate(COMPONENTS)]


def station_rows(stations: Sequence[PairedErrors]) -> list[dict[str, Any]]:
    """Root mean square errors of either engine at each distance."""
    return [
        {
            "distance_m": s.distance_m,
            "pairs": s.pairs,
            "fixes": len(s.one),
            "first_rms": dict(zip(COMPONENTS, _rms(s.one).tolist(), strict=True)),
            "second_rms": dict(zip(COMPONENTS, _rms(s.other).tolist(), strict=True)),
            "difference_rms": dict(zip(COMPONENTS, _rms(s.other - s.one).tolist(), strict=True)),
        }
        for s in stations
    ]


def navigation_table(stations: Sequence[PairedErrors]) -> dict[str, Any]:
    """All figures, for JSON."""
    return {
        "stations": station_rows(stations),
        "ratios": [asdict(row) for row in size_ratios(stations)],
        "mean_differences": [asdict(row) for row in mean_differences(stations)],
    }


def _squares(stations: Sequence[PairedErrors], which: str) -> Array:
    """(n, 2) squared sizes of position and attitude errors, in units of each distance's own mean square."""
    rows = []
    for station in stations:
        both = [_two_squares(errors) for errors in (station.one, station.other)]
        unit = np.concatenate(both).mean(axis=0)
        rows.append(both[0 if which == "one" else 1] / unit)
    return np.concatenate(rows)


def _two_squares(errors: Array) -> Array:
    return np.stack([np.square(errors[:, :3]).sum(axis=1), np.square(errors[:, 3:]).sum(axis=1)], axis=1)


def _root_mean_square(station: PairedErrors) -> Array:
    return _rms(np.concatenate([station.one, station.other]))


def _rms(errors: Array) -> Array:
    result: Array = np.sqrt(np.mean(np.square(errors), axis=0))
    return result
