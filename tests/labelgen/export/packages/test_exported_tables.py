"""WebDataset shards read by `webdataset`, and the Parquet table read by pyarrow."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import webdataset

from datasets_manifest.storage.reader import Dataset
from geometry.stereo import EYES
from labelgen.export.export_log import ExportLog
from labelgen.export.formats import write_export
from labelgen.export.keypoints import view_of
from labelgen.export.packages.tar_shards import write_webdataset


def read_shards(folder: Path) -> list[dict]:
    """All samples by the package itself."""
    shards = sorted(str(path) for path in folder.glob("*.tar"))
    return list(webdataset.WebDataset(shards, shardshuffle=False, empty_check=False))


def test_shards_hold_every_file_of_every_pair(mixed_dataset: Path, tmp_path: Path) -> None:
    source = Dataset(mixed_dataset)
    splits = source.manifest.split_of_frame()
    write_export("webdataset", mixed_dataset, tmp_path / "out", ExportLog())
    samples = read_shards(tmp_path / "out")
    assert sorted(int(sample["__key__"]) for sample in samples) == list(source.frame_indices)
    for sample in samples:
        index = int(sample["__key__"])
        folder = mixed_dataset / "frames" / sample["__key__"]
        record = json.loads(sample["json"])
        assert record.pop("split") == splits[index] and sample["__url__"].split("/")[-1].startswith(splits[index])
        assert record.pop("dataset_sha256") == source.manifest.dataset_sha256
        assert record == json.loads((folder / "record.json").read_text())
        for path in folder.glob("*.png"):
            assert sample[path.name] == path.read_bytes()


def test_webdataset_decodes_images(mixed_dataset: Path, tmp_path: Path) -> None:
    write_export("webdataset", mixed_dataset, tmp_path / "out", ExportLog())
    shard = str(next((tmp_path / "out").glob("*.tar")))
    source = Dataset(mixed_dataset)
    for sample in webdataset.WebDataset([shard], shardshuffle=False).decode("rgb8"):
        np.testing.assert_array_equal(sample["left.png"], source.images(int(sample["__key__"])).left)


def test_shards_end_at_the_limit_and_belong_to_nobody(mixed_dataset: Path, tmp_path: Path) -> None:
    limit = 60_000
    paths = write_webdataset(mixed_dataset, tmp_path / "out", ExportLog(), limit)
    assert len(paths) > 4 and paths == sorted((tmp_path / "out").iterdir())
    for path in paths:
        with tarfile.open(path) as archive:
            members = archive.getmembers()
        assert path.stat().st_size <= limit or len({member.name[:6] for member in members}) == 1
        for member in members:
            assert (member.mtime, member.uid, member.gid, member.uname, member.gname) == (0, 0, 0, "", "")
        assert [member.name for member in members] == sorted(member.name for member in members)
    # A sample is never torn apart.
    assert len(read_shards(tmp_path / "out")) == len(Dataset(mixed_dataset).frame_indices)


@pytest.fixture(scope="module")
def table(mixed_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("parquet")
    write_export("parquet", mixed_dataset, folder, ExportLog())
    return pq.read_table(folder / "views.parquet")


def test_the_table_has_a_row_a_view(table: Any, mixed_dataset: Path) -> None:
    source = Dataset(mixed_dataset)
    rows = table.to_pylist()
    assert [(row["frame_index"], row["view"]) for row in rows] == [
        (i, eye) for i in source.frame_indices for eye in EYES
    ]
    for row in rows:
        record = source.record(row["frame_index"])
        view, pose = view_of(record, row["view"]), record.left_from_drogue
        conditions = record.conditions.model_dump()
        assert {name: row[name] for name in conditions} == conditions
        assert row["has_drogue"] == (pose is not None) and row["truncated"] == view.truncated
        box = [row[f"box_visible_{part}_px"] for part in ("x", "y", "width", "height")]
        assert box == list(view.box_visible_xywh_px or [None] * 4)
        assert row["marker_signal_to_noise"] == [marker.signal_to_noise for marker in view.markers]
        assert row["marker_center_proj_u_px"] == [marker.center_proj_px[0] for marker in view.markers]
        assert row["hub_visible_fraction"] == (None if view.hub is None else view.hub.visible_fraction)
        if pose is None:
            assert row["left_from_drogue"] is None and row["pitch_deg"] is None and row["quaternion_w"] is None
        else:
            np.testing.assert_array_equal(np.reshape(row["left_from_drogue"], (4, 4)), pose.as_matrix())
            x, y, z, w = (row[f"quaternion_{name}"] for name in "xyzw")
            # The axis is the matrix's third column; Hamilton's formula written out, in float64.
            axis = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
            np.testing.assert_allclose(axis, pose.rotation[:, 2], atol=1e-12)


def test_every_column_is_filled_and_described(table: Any, mixed_dataset: Path) -> None:
    unfilled = [name for name in table.column_names if table[name].null_count == table.num_rows]
    # Single frames belong to no sequence, and this engine does not measure its sampling against the sensor.
    assert set(unfilled) <= {"sequence_id", "monte_carlo_over_sensor_noise"}
    about = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert about["dataset_sha256"] == Dataset(mixed_dataset).manifest.dataset_sha256
    assert json.loads(about["conventions"])["quaternion_order"].startswith("x y z w")
