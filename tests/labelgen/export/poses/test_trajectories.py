"""Estimates as trajectories, as evo reads them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_manifest.storage.layout import RECORD_FILE
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, read_estimates, write_estimates
from geometry.se3 import RigidTransform
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from tests.support.other_python import read_by

# One estimate is a millimetre and half a degree off, and turned by five eighths of a turn, which no method can see.
ERROR = RigidTransform(Rotation.from_euler("x", 0.5, degrees=True).as_matrix(), np.array([0.0, 0.0, 0.001]))
UNSEEN_TURN = RigidTransform(Rotation.from_euler("z", 5 * 45, degrees=True).as_matrix(), np.zeros(3))

READ_BY_EVO = """
import json, sys
from evo.core import metrics, sync
from evo.tools import file_interface
truth, estimate = map(file_interface.read_tum_trajectory_file, sys.argv[1:])
count = truth.num_poses
truth, estimate = sync.associate_trajectories(truth, estimate, max_diff=1e-6)
told = {"truth": count, "matched": estimate.num_poses}
for name, relation in (("m", metrics.PoseRelation.translation_part), ("deg", metrics.PoseRelation.rotation_angle_deg)):
    error = metrics.APE(relation)
    error.process_data((truth, estimate))
    told[name] = error.error.tolist()
print(json.dumps(told))
"""


@pytest.fixture
def dataset(dataset_by_preset: Callable[..., Path]) -> Path:
    return dataset_by_preset("mono")


def estimates_of(dataset: Path, path: Path) -> Path:
    """Of two methods, one of which misses the first pair that has a drogue."""
    source = Dataset(dataset)
    poses = {index: source.record(index).left_from_drogue for index in source.frame_indices}
    fixes: list[Estimate] = []
    for index, pose in poses.items():
        if pose is not None:
            fixes.append(PoseEstimate(frame_index=index, method="joint", left_from_drogue=pose @ ERROR @ UNSEEN_TURN))
            fixes.append(PoseEstimate(frame_index=index, method="exact", left_from_drogue=pose))
    assert len(fixes) >= 4
    fixes[0] = NoFix(frame_index=fixes[0].frame_index, method="joint", reason="too dark")
    write_estimates(path, fixes)
    return path


def numbers(path: Path) -> np.ndarray:
    return np.loadtxt(path, ndmin=2)


def test_every_pose_has_the_time_and_the_attitude_of_the_truth(dataset: Path, tmp_path: Path) -> None:
    log, estimates = ExportLog(), estimates_of(dataset, tmp_path / "estimates.jsonl")
    folders = write_export("tum", dataset, tmp_path / "out", log, estimates=estimates)
    assert [folder.name for folder in folders] == ["truth", "joint", "exact"]
    truth, joint, exact = (numbers(folder / "single_pairs.txt") for folder in folders)
    write_export("tum", dataset, tmp_path / "alone", ExportLog())
    assert (tmp_path / "alone" / "single_pairs.txt").read_text() == (folders[0] / "single_pairs.txt").read_text()
    np.testing.assert_array_equal(exact, truth)
    np.testing.assert_array_equal(joint[:, 0], truth[1:, 0])
    between = Rotation.from_quat(truth[1:, 4:]).inv() * Rotation.from_quat(joint[:, 4:])
    # Half a degree and the roundings of two quaternions; the unseen turn is gone.
    np.testing.assert_allclose(np.rad2deg(between.magnitude()), 0.5, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(joint[:, 1:4] - truth[1:, 1:4], axis=1), 0.001, atol=1e-12)
    assert log.losses["pairs in which joint gives no pose are left out"] >= 1


def test_a_roll_that_an_estimate_leaves_open_is_no_error(dataset: Path, tmp_path: Path) -> None:
    """A rim has no roll: the pose has roll 0, and a covariance that says how little that means."""
    source, estimates = Dataset(dataset), tmp_path / "estimates.jsonl"
    fixes: list[Estimate] = []
    for index in source.frame_indices:
        pose = source.record(index).left_from_drogue
        if pose is None:
            continue
        yaw, pitch, _ = Rotation.from_matrix(pose.rotation).as_euler("YXZ")
        without_roll = RigidTransform(Rotation.from_euler("YXZ", [yaw, pitch, 0.0]).as_matrix(), pose.translation_m)
        axis, covariance = pose.rotation[:, 2], 1e-4 * np.eye(6)
        covariance[3:, 3:] += np.pi**2 / 3 * np.outer(axis, axis)
        fixes.append(
            PoseEstimate(frame_index=index, method="joint-rim", left_from_drogue=without_roll, covariance=covariance)
        )
    write_estimates(estimates, fixes)
    log = ExportLog()
    folders = write_export("tum", dataset, tmp_path / "out", log, estimates=estimates)
    truth, rim = (numbers(folder / "single_pairs.txt") for folder in folders)
    between = Rotation.from_quat(truth[:, 4:]).inv() * Rotation.from_quat(rim[:, 4:])
    # Roundings of matrices and quaternions.
    assert between.magnitude().max() < 1e-7
    assert log.losses["poses of joint-rim leave the roll open: it is the truth's"] == len(fixes)


def test_pairs_without_a_drogue_are_counted_beside_estimates(mixed_dataset: Path, tmp_path: Path) -> None:
    log, estimates = ExportLog(), estimates_of(mixed_dataset, tmp_path / "estimates.jsonl")
    truth, *_ = write_export("tum", mixed_dataset, tmp_path / "out", log, estimates=estimates)
    without = len(Dataset(mixed_dataset).frame_indices) - len(numbers(truth / "single_pairs.txt"))
    assert without > 0 and log.losses["pairs without a drogue are left out of the truth"] == without


def test_evo_gives_the_errors_that_were_made(dataset: Path, tmp_path: Path) -> None:
    estimates = estimates_of(dataset, tmp_path / "estimates.jsonl")
    truth, joint, _ = write_export("tum", dataset, tmp_path / "out", ExportLog(), estimates=estimates)
    files = (truth / "single_pairs.txt", joint / "single_pairs.txt")
    told = read_by("evo", READ_BY_EVO, *files, folder=tmp_path)
    assert told["matched"] == told["truth"] - 1
    # evo's own arithmetic.
    np.testing.assert_allclose(told["m"], 0.001, atol=1e-9)
    np.testing.assert_allclose(told["deg"], 0.5, atol=1e-6)


def test_a_dataset_without_truth_has_estimates_alone(dataset: Path, tmp_path: Path) -> None:
    write_export("blind", dataset, tmp_path / "blind", ExportLog())
    estimates = estimates_of(dataset, tmp_path / "estimates.jsonl")
    folders = write_export("tum", tmp_path / "blind", tmp_path / "out", ExportLog(), estimates=estimates)
    assert [folder.name for folder in folders] == ["joint", "exact"]
    source = Dataset(dataset)
    truth = [record for record in map(source.record, source.frame_indices) if record.left_from_drogue is not None]
    got = numbers(folders[1] / "single_pairs.txt")
    # Times have nine decimals.
    np.testing.assert_allclose(got[:, 0], [record.time_s for record in truth], atol=1e-9)
    positions_m = [record.left_from_drogue.translation_m for record in truth if record.left_from_drogue is not None]
    np.testing.assert_array_equal(got[:, 1:4], positions_m)


def test_estimates_of_a_damaged_pair_are_left_out_with_it(dataset: Path, tmp_path: Path) -> None:
    estimates, faults = estimates_of(dataset, tmp_path / "estimates.jsonl"), PairFaults()
    write_export("tum", dataset, tmp_path / "whole", ExportLog(), estimates=estimates)
    shutil.copytree(dataset, tmp_path / "damaged")
    last = Dataset(dataset).frame_indices[-1]
    (tmp_path / "damaged" / "frames" / f"{last:06d}" / "record.json").write_text("{")
    write_export("tum", tmp_path / "damaged", tmp_path / "out", ExportLog(faults=faults), estimates=estimates)
    assert faults.count == 1 and faults.first is not None and faults.first[0] == last
    for name in ("truth", "exact"):
        whole, rest = (numbers(tmp_path / out / name / "single_pairs.txt") for out in ("whole", "out"))
        np.testing.assert_array_equal(rest, whole[:-1])


def test_times_before_zero_are_written_as_they_are(dataset: Path, tmp_path: Path) -> None:
    write_export("blind", dataset, tmp_path / "blind", ExportLog())
    for path in (tmp_path / "blind" / "frames").glob("*/" + RECORD_FILE):
        table = json.loads(path.read_text())
        path.write_text(json.dumps(table | {"time_s": 0.25 * int(path.parent.name) - 1.75}))
    estimates = estimates_of(dataset, tmp_path / "estimates.jsonl")
    _, exact = write_export("tum", tmp_path / "blind", tmp_path / "out", ExportLog(), estimates=estimates)
    fixes = [fix.frame_index for fix in read_estimates(estimates) if fix.method == "exact"]
    want = [0.25 * index - 1.75 for index in fixes]
    assert min(want) < -1
    np.testing.assert_array_equal(numbers(exact / "single_pairs.txt")[:, 0], want)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"frame_index": 99}, r"estimates\.jsonl: frame 99 is not in the dataset"),
        ({"method": "../joint"}, r"method '\.\./joint' cannot be a folder"),
        ({"method": "truth"}, "method 'truth' cannot be a folder"),
        ({"method": "exact"}, "method 'exact': frame [0-9]+ occurs twice"),
        ({"left_from_drogue": None}, r"estimates\.jsonl, line 3: not a pose estimate"),
    ],
)
def test_wrong_estimates_are_one_line_and_leave_nothing(
    change: dict[str, object], fault: str, dataset: Path, tmp_path: Path
) -> None:
    path = estimates_of(dataset, tmp_path / "estimates.jsonl")
    lines = path.read_text().splitlines()
    lines[2] = json.dumps(json.loads(lines[2]) | change)
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=fault):
        write_export("tum", dataset, tmp_path / "out", ExportLog(), estimates=path)
    assert not (tmp_path / "out").exists()
    path.write_text("")
    with pytest.raises(ValueError, match="holds no estimates"):
        write_export("tum", dataset, tmp_path / "out", ExportLog(), estimates=path)
