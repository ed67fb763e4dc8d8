from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.records import PairRecord
from labelgen.export.export_log import ExportLog, SequenceOrder
from labelgen.export.formats import write_export
from tests.support.drawn_pairs import Pair


def stamped(record: PairRecord, sequence_id: int | None, time_s: float) -> PairRecord:
    return record.model_copy(update={"sequence_id": sequence_id, "time_s": time_s})


def test_sequences_begin_where_their_number_changes(pairs: list[Pair]) -> None:
    order = SequenceOrder()
    record = pairs[0].record
    firsts = []
    for sequence_id, time_s in ((0, 0.1), (0, 0.2), (1, 0.0), (1, 0.04), (None, 0.0)):
        assert order.stamp_ns(stamped(record, sequence_id, time_s)) == round(1e9 * time_s)
        firsts.append(order.is_first)
    assert firsts == [True, False, True, False, True]


@pytest.mark.parametrize(
    ("steps", "fault"),
    [
        (((0, 0.1), (0, 0.1)), "later than"),
        (((0, 0.1), (1, 0.1), (0, 0.3)), "had ended before"),
        (((None, 0.1), (1, 0.1), (None, 0.3)), "had ended before"),
        (((0, -1.0),), "must be in"),
        (((0, float("nan")),), "must be in"),
    ],
)
def test_pairs_out_of_order_are_refused(
    pairs: list[Pair], steps: tuple[tuple[int | None, float], ...], fault: str
) -> None:
    order = SequenceOrder()
    with pytest.raises(ValueError, match=fault):
        for sequence_id, time_s in steps:
            order.stamp_ns(stamped(pairs[0].record, sequence_id, time_s))


def test_tum_lines_are_the_true_poses(small_dataset: Path, tmp_path: Path) -> None:
    log = ExportLog()
    (file,) = write_export("tum", small_dataset, tmp_path / "tum", log)
    lines = np.loadtxt(file)
    source = Dataset(small_dataset)
    records = [source.record(index) for index in source.frame_indices]
    seen = [record for record in records if record.left_from_drogue is not None]
    assert len(lines) == len(seen)
    assert log.losses == {"pairs without a drogue are left out": len(records) - len(seen)}
    for line, record in zip(lines, seen, strict=True):
        assert line[0] == pytest.approx(record.time_s, abs=1e-9)
        np.testing.assert_array_equal(line[1:4], record.left_from_drogue.translation_m)
        # A quaternion there and back costs a few roundings.
        rotation = Rotation.from_quat(line[4:]).as_matrix()
        np.testing.assert_allclose(rotation, record.left_from_drogue.rotation, atol=1e-12)


def test_every_sequence_gets_a_file_and_a_bag(small_dataset: Path, tmp_path: Path) -> None:
    source = Dataset(small_dataset)
    half = len(source.frame_indices) // 2
    for place, frame_index in enumerate(source.frame_indices):
        path = small_dataset / "frames" / f"{frame_index:06d}" / "record.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "sequence_id": place // half}))
    texts = write_export("tum", small_dataset, tmp_path / "tum", ExportLog())
    assert [path.name for path in texts] == ["sequence_0000.txt", "sequence_0001.txt"]
    bags = write_export("rosbag", small_dataset, tmp_path / "bags", ExportLog())
    assert [path.name for path in bags] == ["sequence_0000", "sequence_0001"]
    for folder in bags:
        with (folder / f"{folder.name}.mcap").open("rb") as stream:
            summary = make_reader(stream).get_summary()
        counts = {summary.channels[id_].topic: n for id_, n in summary.statistics.channel_message_counts.items()}
        assert counts["/stereo/left/image_raw"] == half and counts["/tf_static"] == 1
