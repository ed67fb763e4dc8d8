"""A docking dataset with estimates: scores of all pairs or of those in view, and one run over its image number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.estimates import Estimate, PoseEstimate
from datasets_manifest.types.records import PairRecord, ViewRecord
from droguekit.scoring.confidence_intervals import Interval, bootstrap_intervals
from droguekit.scoring.pose_benchmark import score_methods
from droguekit.scoring.poses.drogue_truth import VISIBLE_FRACTION, drogue_truth
from droguekit.scoring.poses.pose_errors import pose_error
from droguekit.scoring.results.benchmark_result import BenchmarkResult, DatasetFacts
from geometry.se3 import Array, RigidTransform
from studies.paper.paper_inputs import ExperimentData, read_estimates_file

LEAST_MARKERS = 4


@dataclass(frozen=True, eq=False)
class DockingRun:
    """One sequence over its image number.

    Attributes:
        sequence_id: of the dataset, None where pairs belong to none.
        numbers: (N,) image number of the pairs that show a drogue, 0 at the first pair of the sequence.
        truth: (N, 3) X, Y, Z in the left camera. [m]
        errors: (N, 5) estimate minus truth by method, X, Y, Z in the left camera [m], pitch and yaw of the axis [deg];
            NaN where it gave no pose.
    """

    sequence_id: int | None
    numbers: NDArray[np.int64]
    truth: Array
    errors: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class DockingData(ExperimentData):
    """A docking dataset with estimates and their scores.

    Attributes:
        records: of every pair that shows a drogue, by frame.
        first_frames: first pair of every sequence, whether it shows a drogue or not; None means no sequence.
        result: scores of the contenders.
    """

    records: Mapping[int, PairRecord]
    first_frames: Mapping[int | None, int]
    result: BenchmarkResult

    @property
    def methods(self) -> Mapping[str, Mapping[int, Estimate]]:
        """The contenders' estimates by method and frame."""
        return self.file.methods

    def pose_errors(self, method: str) -> dict[int, Array]:
        """(5,) estimate minus truth by frame, where the method gave a pose of a drogue."""
        return {
            index: pose_error(estimate.left_from_drogue, _pose(self.records[index])).components
            for index, estimate in self.methods[method].items()
            if isinstance(estimate, PoseEstimate) and index in self.records
        }

    def sequences(self) -> list[int | None]:
        """Ids of the sequences, ascending; only None where pairs belong to none."""
        ids = {record.sequence_id for record in self.records.values()}
        return sorted(ids, key=lambda number: (number is None, number or 0))

    def run(self, sequence_id: int | None) -> DockingRun:
        """One sequence.

        Raises:
            ValueError: the dataset has no such sequence.
        """
        indices = [index for index, record in self.records.items() if record.sequence_id == sequence_id]
        if not indices:
            known = [str(number) for number in self.sequences() if number is not None]
            rule = f"must be one of {', '.join(known)}" if known else "must be left out, for there are no sequences"
            raise ValueError(f"--docking-sequence: {rule} in {self.source}, got {sequence_id}")
        errors = {}
        for contender in self.contenders:
            found = self.pose_errors(contender.method)
            nothing = np.full(5, np.nan)
            errors[contender.method] = np.array([found.get(index, nothing) for index in indices])
        truth = np.array([_pose(self.records[index]).translation_m for index in indices])
        return DockingRun(sequence_id, np.array(indices) - self.first_frames[sequence_id], truth, errors)


@dataclass(frozen=True, eq=False)
class SubsetScores:
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


def read_docking(dataset: Location, estimates: Path) -> DockingData:
    """Read and score a dataset with its estimates.

    Raises:
        ValueError: dataset or file cannot be read, do not belong together, or hold none of the contenders.
    """
    data = Dataset(dataset)
    file = read_estimates_file(estimates, data.frame_indices)
    records = {index: data.record(index) for index in sorted(data.frame_indices)}
    first_frames: dict[int | None, int] = {}
    for index, record in records.items():
        first_frames.setdefault(record.sequence_id, index)
    manifest = data.manifest
    facts = DatasetFacts(name=manifest.name, sha256=manifest.dataset_sha256, pairs=len(records))
    result = score_methods(facts, {index: drogue_truth(record) for index, record in records.items()}, file.methods)
    shown = {index: record for index, record in records.items() if record.left_from_drogue is not None}
    return DockingData(data, file, shown, first_frames, result)


def subset_scores(errors: Mapping[int, Array], frames: Sequence[int], key: str) -> SubsetScores:
    """Scores over some pairs, of which there is at least one.

    Args:
        errors: (5,) X, Y, Z [m], pitch, yaw [deg] by frame, where there is a pose.
        frames: which pairs count.
        key: of the bootstrap's random stream.
    """
    rows = np.array([errors[index] for index in frames if index in errors])
    if not len(rows):
        return SubsetScores(0.0)
    lengths = np.linalg.norm(rows[:, :3], axis=1)
    means, _ = bootstrap_intervals(lengths[:, None], (99.0,), key)
    sizes = np.abs(rows)
    return SubsetScores(
        fix_fraction=len(rows) / len(frames),
        mean_m=float(lengths.mean()),
        interval_m=(float(means[0, 0]), float(means[0, 1])),
        p99_m=float(np.percentile(lengths, 99.0)),
        largest_m=sizes[:, :3].max(axis=0),
        angles_p99_deg=np.percentile(sizes[:, 3:], 99.0, axis=0),
    )


def frames_in_view(records: Mapping[int, PairRecord]) -> list[int]:
    """Pairs of which both eyes see at least four markers and the hub: wholly on the image, at most a tenth hidden."""
    return [
        index
        for index, record in records.items()
        if all(_is_enough(view) for view in (record.views.left, record.views.right))
    ]


def _pose(record: PairRecord) -> RigidTransform:
    if record.left_from_drogue is None:
        raise ValueError(f"frame {record.frame_index}: shows no drogue")
    return record.left_from_drogue


def _is_enough(view: ViewRecord) -> bool:
    seen = sum(marker.in_image and marker.visible_fraction >= VISIBLE_FRACTION for marker in view.markers)
    hub = view.hub
    return seen >= LEAST_MARKERS and hub is not None and hub.in_image and hub.visible_fraction >= VISIBLE_FRACTION
