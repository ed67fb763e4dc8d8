"""The reference that all methods of a file are compared with: bins of distance, centroid noise, bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from droguekit.scoring.poses.centroid_errors import CentroidErrors, centroid_statistics
from droguekit.scoring.poses.cramer_rao import FeatureNoise, component_deviations, pose_covariance
from droguekit.scoring.poses.drogue_truth import DrogueTruth
from droguekit.scoring.results.benchmark_result import ReferenceBin
from droguekit.scoring.results.pose_result import Bound, CentroidStatistics
from geometry.se3 import Array, angles_from_axis

# Distances this close count as one station.
_STATION_TOLERANCE = 0.01
_MOST_STATIONS = 30
# Log-spaced bins: two to a doubling of the distance, unless that leaves fewer frames in them than a percentile needs.
_BINS_PER_DOUBLING = 2
_FRAMES_PER_BIN = 10
_MOST_BINS = 12
# A method that measures only the easy centroids may not set the reference noise.
_FEWEST_OF_MOST = 0.5


@dataclass(frozen=True)
class DistanceBin:
    """Distances from `low_m` to `high_m`; a station's are those of its nearest and farthest frame. [m]"""

    low_m: float
    high_m: float


@dataclass(frozen=True, eq=False)
class Reference:
    """Bins, noise and bounds that are the same for all methods of a file.

    Attributes:
        bins: with their noise and bound.
        bin_of_frame: for pairs that show a drogue.
        bounds: (5,) by frame, every feature at the markers' noise of its bin; None where there is none.
        covariances: (6, 6) by frame, markers and hub each at its own noise; None where there is none.
        truth_spread: (5,) standard deviations of the true X, Y, Z [m], pitch and yaw [deg] of the dataset.
    """

    bins: list[ReferenceBin]
    bin_of_frame: dict[int, int]
    bounds: dict[int, Array | None]
    covariances: dict[int, Array | None]
    truth_spread: Array


def build_reference(
    drogues: Mapping[int, DrogueTruth], centroids: Mapping[str, Mapping[int, CentroidErrors]]
) -> Reference:
    """Noise and bounds of a dataset's pairs.

    Args:
        drogues: by frame, at least one.
        centroids: by method and frame.
    """
    places, labels = distance_bins([truth.distance_m for truth in drogues.values()])
    bin_of_frame = dict(zip(drogues, labels, strict=True))
    rows: list[ReferenceBin] = []
    bounds: dict[int, Array | None] = {}
    covariances: dict[int, Array | None] = {}
    for k, place in enumerate(places):
        frames = [index for index in drogues if bin_of_frame[index] == k]
        found = {name: centroid_statistics([errors[i] for i in frames]) for name, errors in centroids.items()}
        row = _reference_bin(place, len(frames), found)
        marker_px = row.centroid_sigma_px
        for i in frames:
            alike = bound_covariance(drogues[i], drogues[i].visible, feature_noise(marker_px, None))
            bounds[i] = None if alike is None else component_deviations(drogues[i].left_from_drogue, alike)
            own_noise = feature_noise(marker_px, row.hub_sigma_px)
            covariances[i] = bound_covariance(drogues[i], drogues[i].visible, own_noise)
        rows.append(row.model_copy(update={"bound": mean_bound([bounds[i] for i in frames])}))
    return Reference(rows, bin_of_frame, bounds, covariances, _truth_spread(list(drogues.values())))


def distance_bins(distances_m: Sequence[float]) -> tuple[list[DistanceBin], list[int]]:
    """Bins, nearest first, and the bin of each frame.

    One bin for each station when the distances form stations within 1 %, else bins between log-spaced edges from
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


def bound_covariance(truth: DrogueTruth, seen: NDArray[np.bool_], noise: FeatureNoise | None) -> Array | None:
    """(6, 6) Cramer-Rao bound of a pose, or None where the noise is unknown or the pose open.

    Args:
        truth: of the pair.
        seen: (2, M) which features are measured.
        noise: of their centroids.
    """
    if noise is None:
        return None
    whitened = truth.jacobian / noise.by_feature(truth.layout)[:, None, None]
    return pose_covariance(whitened[seen])


def mean_bound(bounds: Sequence[Array | None]) -> Bound | None:
    """Root mean square of the bounds of the frames that have one, or None where none has."""
    known = [bound for bound in bounds if bound is not None]
    if not known:
        return None
    squares = np.mean(np.square(known), axis=0)
    x, y, z, pitch, yaw = np.sqrt(squares).tolist()
    position = float(np.sqrt(squares[:3].sum()))
    return Bound(position_m=position, x_m=x, y_m=y, z_m=z, pitch_deg=pitch, yaw_deg=yaw)


def feature_noise(marker_px: float | None, hub_px: float | None) -> FeatureNoise | None:
    """Measured noise; a hub that no method measured gets the noise of the markers.

    None where the centroids have no error at all, as those of another program's truth: they set no bound.
    """
    if not marker_px or hub_px == 0:
        return None
    return FeatureNoise(marker_px, marker_px if hub_px is None else hub_px)


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


def _reference_bin(place: DistanceBin, count: int, found: Mapping[str, CentroidStatistics]) -> ReferenceBin:
    method, sigma = _best(found, lambda s: (s.count, s.sigma_px))
    hub_method, hub_sigma = _best(found, lambda s: (s.hub_count, s.hub_sigma_px))
    return ReferenceBin(
        low_m=place.low_m,
        high_m=place.high_m,
        n=count,
        centroid_sigma_px=sigma,
        centroid_method=method,
        hub_sigma_px=hub_sigma,
        hub_method=hub_method,
        bound=None,
    )


def _best(
    found: Mapping[str, CentroidStatistics], kind: Callable[[CentroidStatistics], tuple[int, float | None]]
) -> tuple[str | None, float | None]:
    """The method with the least noise among those that measured enough features of a kind, and that noise. [px]"""
    kinds = {name: kind(statistics) for name, statistics in found.items()}
    most = max(count for count, _ in kinds.values())
    sigmas = {
        name: sigma for name, (count, sigma) in kinds.items() if sigma is not None and count >= _FEWEST_OF_MOST * most
    }
    if not sigmas:
        return None, None
    best = min(sigmas, key=lambda name: sigmas[name])
    return best, sigmas[best]


def _truth_spread(truths: Sequence[DrogueTruth]) -> Array:
    places = np.array([truth.left_from_drogue.translation_m for truth in truths])
    angles = angles_from_axis(np.array([truth.left_from_drogue.rotation[:, 2] for truth in truths]))
    spread: Array = np.concatenate([places.std(axis=0), np.rad2deg(np.std(angles, axis=1))])
    return spread
