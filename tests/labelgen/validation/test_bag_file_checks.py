from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.drawn_pairs import Pair


@pytest.fixture
def with_bags(small_dataset: Path, tmp_path: Path) -> Path:
    """A dataset into whose folder its user has moved the bags."""
    write_export("rosbag", small_dataset, tmp_path / "bags", ExportLog())
    shutil.move(tmp_path / "bags", small_dataset / "bags")
    return small_dataset


def test_bags_in_a_dataset_are_read(with_bags: Path) -> None:
    report = validate_dataset(with_bags)
    assert report.faults == [] and {check.name: check.count for check in report.checks}["bags"] == 1
    (bag,) = (with_bags / "bags").rglob("*.mcap")
    whole = bag.read_bytes()
    bag.write_bytes(whole[: len(whole) // 2])
    (fault,) = validate_dataset(with_bags).faults
    assert fault.startswith(f"{bag}: ") and "\n" not in fault


def test_more_pairs_in_bags_than_in_the_dataset_are_a_fault(with_bags: Path, pairs: list[Pair]) -> None:
    shutil.copytree(with_bags / "bags", with_bags / "again")
    (fault,) = validate_dataset(with_bags).faults
    assert fault.endswith(f"bags hold {2 * len(pairs)} pairs, the dataset {len(pairs)}")
