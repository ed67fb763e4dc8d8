from __future__ import annotations

from pathlib import Path

from datasets_manifest.storage.reader import Dataset
from labelgen.validation.dataset_checks import validate_dataset


def test_a_rendered_dataset_passes(smoke_dataset: Path) -> None:
    report = validate_dataset(smoke_dataset)
    assert report.faults == []


def test_unoccluded_markers_are_exactly_whole(smoke_dataset: Path) -> None:
    """Nothing stands before the drogue there: every pixel that a marker could cover shows it."""
    dataset = Dataset(smoke_dataset)
    for frame_index in dataset.frame_indices:
        views = dataset.record(frame_index).views
        for view in (views.left, views.right):
            assert {marker.visible_fraction for marker in view.markers} == {1.0}
