"""The bench experiment: a drogue at stations, its distance read by a rangefinder, errors averaged at each station."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import Estimate, Feature, PoseEstimate
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from geometry.se3 import Array
from studies.paper.paper_inputs import ExperimentData, read_estimates_file

# Centroids lie within a pixel of their markers. Five markers in the place of seven lie 10 degrees off in the median, on
# a ring whose image has a radius of more than 40 px at 10 m: 7 px there and more elsewhere.
_MOST_OFF_PX = 5.0


@dataclass(frozen=True, eq=False)
class StationErrors:
    """A method at each station: means over the pairs in which it found a pose; NaN where it found none.

    Attributes:
        poses, pairs: found in how many pairs that show a drogue, over all stations.
        false_poses, empty_pairs: given in how many pairs without a drogue.
        x_m, y_m: (S,) mean size of the error. [m]
        z_m: (S,) the same in depth, against the reading. [m]
        z_fraction, z_true_fraction: (S,) mean size of the depth error over the depth, against reading and truth.
        reading_m, measured_m: (S,) mean reading, and mean measured depth. [m]
    """

    poses: int
    pairs: int
    false_poses: int
    empty_pairs: int
    x_m: Array
    y_m: Array
    z_m: Array
    z_fraction: Array
    z_true_fraction: Array
    reading_m: Array
    measured_m: Array

    @property
    def stations_text(self) -> str:
        """At how many of the stations there is a pose; means are over these alone."""
        return f"{int(np.isfinite(self.x_m).sum())} of {len(self.x_m)}"


@dataclass(frozen=True, eq=False)
class SemiPhysicalRun(ExperimentData):
    """One dataset of the experiment.

    Attributes:
        markers: of the drogue.
        stations_m: (S,) ascending. [m]
        methods: by name.
    """

    markers: int
    stations_m: Array
    methods: Mapping[str, StationErrors]


def read_semi_physical(dataset: Location, estimates: Path, faults: PairFaults | None = None) -> SemiPhysicalRun:
    """Read a dataset of the experiment with its estimates; damaged pairs are left out where `faults` counts them.

    Raises:
        ValueError: dataset or file cannot be read or do not belong together, or the dataset has no stations or no
            readings of a rangefinder.
    """
    data = Dataset(dataset)
    stations = data.manifest.recipe.distance.stations_m
    if not stations:
        raise ValueError(f"{dataset}: its recipe has no stations; the experiment is the recipe semi-physical-5 or -7")
    records = {record.frame_index: record for record in data.records(faults)}
    shown = {index: record for index, record in records.items() if record.left_from_drogue is not None}
    if not shown or any(record.frame.rangefinder_reading_m is None for record in shown.values()):
        raise ValueError(f"{dataset}: has no rangefinder's readings; its recipe needs the section [rangefinder]")
    markers = marker_layout(data.manifest.recipe.drogue).count
    file = read_estimates_file(estimates, data.frame_indices)
    _check_markers(file.methods, shown, markers, f"{estimates}, for {dataset}")
    places = np.array(sorted(stations))
    methods = {name: _station_errors(records, of_method, places) for name, of_method in file.methods.items()}
    return SemiPhysicalRun(data, file, markers, places, methods)


def _check_markers(
    methods: Mapping[str, Mapping[int, Estimate]], records: Mapping[int, PairRecord], count: int, source: str
) -> None:
    """Files of two such datasets have the same frames, so a mistaken one shows by its markers only."""
    off_px = []
    for estimates in methods.values():
        for estimate in estimates.values():
            for feature in estimate.features:
                if feature.index == "hub":
                    continue
                if not 0 <= feature.index < count:
                    raise ValueError(
                        f"{source}: frame {estimate.frame_index}: measures marker {feature.index}, and the drogue has "
                        f"{count}; give the estimates of this dataset"
                    )
                if estimate.frame_index in records:
                    off_px.append(_off_px(records[estimate.frame_index], feature))
    if off_px and (middle_px := float(np.median(off_px))) > _MOST_OFF_PX:
        raise ValueError(
            f"{source}: half of the measured markers lie {middle_px:.1f} px or more beside any of the drogue's "
            f"{count}; give the estimates of this dataset"
        )


def _off_px(record: PairRecord, feature: Feature) -> float:
    """How far a centroid lies from the nearest marker, for markers that look alike may be counted from any. [px]"""
    centers = np.array([marker.center_ellipse_px for marker in getattr(record.views, feature.eye).markers])
    return float(np.linalg.norm(centers - feature.center_px, axis=1).min())


def _station_errors(
    records: Mapping[int, PairRecord], estimates: Mapping[int, Estimate], stations_m: Array
) -> StationErrors:
    rows: list[list[list[float]]] = [[] for _ in stations_m]
    empty = [index for index, record in records.items() if record.left_from_drogue is None]
    for index, record in records.items():
        estimate, pose = estimates.get(index), record.left_from_drogue
        reading_m = record.frame.rangefinder_reading_m
        if not isinstance(estimate, PoseEstimate) or pose is None or reading_m is None:
            continue
        measured, true = estimate.left_from_drogue.translation_m, pose.translation_m
        place = int(np.argmin(np.abs(stations_m - true[2])))
        z_m, z_true_m = abs(measured[2] - reading_m), abs(measured[2] - true[2])
        sizes = [*np.abs(measured - true)[:2], z_m, z_m / reading_m, z_true_m / true[2], reading_m, measured[2]]
        rows[place].append([float(size) for size in sizes])
    means = np.array([np.mean(row, axis=0) if row else np.full(7, np.nan) for row in rows])
    false = sum(isinstance(estimates.get(index), PoseEstimate) for index in empty)
    return StationErrors(sum(map(len, rows)), len(records) - len(empty), false, len(empty), *means.T)
