"""Which distances are looked at together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Distances this close count as one station.
_STATION_TOLERANCE = 0.01
_MOST_STATIONS = 30

# Log-spaced bins: two to a doubling of the distance, unless that leaves fewer frames in them than a percentile needs.
_BINS_PER_DOUBLING = 2
_FRAMES_PER_BIN = 10
_MOST_BINS = 12


@dataclass(frozen=True)
class DistanceBin:
    """Distances from `low_m` to `high_m`; a station's are those of its nearest and farthest frame. [m]"""

    low_m: float
    high_m: float


def distance_bins(distances_m: Sequence[float]) -> tuple[list[DistanceBin], list[int]]:
    """Bins, nearest first, and the bin of each frame.

    One bin for each station when the distances stand at stations within 1 %, else bins between log-spaced edges from
    the smallest to the largest distance, without those that hold no frame.

    Args:
        distances_m: one for each frame. [m]

    Raises:
        ValueError: a distance that is not positive.
    """
    values = np.asarray(distances_m, dtype=np.float64)
    if not len(values):
        return [], []
    if not (values > 0).all():
        raise ValueError(f"distances_m: must be positive, got {values.min()}")
    labels = _stations(values)
    if labels is not None:
        bins = [
            DistanceBin(float(values[labels == k].min()), float(values[labels == k].max()))
            for k in range(labels.max() + 1)
        ]
        return bins, labels.tolist()
    edges = _log_edges(values)
    places = np.searchsorted(edges, values, side="right") - 1
    filled, labels = np.unique(places, return_inverse=True)
    return [DistanceBin(float(edges[k]), float(edges[k + 1])) for k in filled], labels.tolist()


def _stations(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> np.ndarray[tuple[int], np.dtype[np.intp]] | None:
    """Station of each distance, or None where they are spread."""
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    starts = np.concatenate([[True], ascending[1:] > ascending[:-1] * (1 + _STATION_TOLERANCE)])
    group = np.cumsum(starts) - 1
    count = int(group[-1]) + 1
    if count > _MOST_STATIONS or 2 * count > len(values) > 1:
        return None
    low = ascending[starts]
    high = ascending[np.append(np.flatnonzero(starts)[1:] - 1, len(values) - 1)]
    # Within the tolerance of the station on both sides.
    if (high > low * (1 + _STATION_TOLERANCE) ** 2).any():
        return None
    labels = np.empty(len(values), dtype=np.intp)
    labels[order] = group
    return labels


def _log_edges(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Edges of the bins; the last one lies just above the largest distance, so that it belongs to the last bin."""
    low, high = float(values.min()), float(values.max())
    by_range = int(np.ceil(_BINS_PER_DOUBLING * np.log2(high / low)))
    count = min(max(1, by_range), max(1, len(values) // _FRAMES_PER_BIN), _MOST_BINS)
    edges = np.geomspace(low, high, count + 1)
    edges[0], edges[-1] = low, np.nextafter(high, np.inf)
    return edges
