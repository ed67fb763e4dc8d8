"""True trajectories in the text format of the TUM RGB-D benchmark, one file for each sequence."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from scipy.spatial.transform import Rotation

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PairRecord
from labelgen.export.export_log import ExportLog
from labelgen.export.sequences import SequenceOrder, sequence_name

_HEADER = (
    "# drogue in the left camera (x right, y down, z forward) at mid-exposure\n# time_s tx_m ty_m tz_m qx qy qz qw\n"
)


def write_tum(dataset: Location, out: Path, log: ExportLog) -> list[Path]:
    """Write a file a sequence, a line a pair.

    Args:
        dataset: folder.
        out: folder to make.
        log: is told the progress, and which pairs have no pose.

    Returns:
        The files.

    Raises:
        ValueError: a record that cannot be read, or times that do not ascend.
        OSError: it cannot be written; nothing half-written is left.

    Source: the benchmark's page on its file formats.
    """
    order, names = SequenceOrder(), []
    with new_folder(out) as folder:
        stamped = _stamped(order, log.records(Dataset(dataset)))
        for sequence_id, pairs in groupby(stamped, key=lambda pair: pair[0].sequence_id):
            names.append(f"{sequence_name(sequence_id)}.txt")
            with (folder / names[-1]).open("w", encoding="utf-8") as stream:
                stream.write(_HEADER)
                for record, stamp_ns in pairs:
                    if record.left_from_drogue is None:
                        log.lost("pairs without a drogue are left out")
                        continue
                    stream.write(_line(record, stamp_ns))
    return [out / name for name in names]


def _stamped(order: SequenceOrder, records: Iterator[PairRecord]) -> Iterator[tuple[PairRecord, int]]:
    for record in records:
        yield record, order.stamp_ns(record)


def _line(record: PairRecord, stamp_ns: int) -> str:
    assert record.left_from_drogue is not None
    pose = record.left_from_drogue
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    numbers = [*pose.translation_m.tolist(), *Rotation.from_matrix(pose.rotation).as_quat().tolist()]
    return f"{seconds}.{nanoseconds:09d} " + " ".join(repr(number) for number in numbers) + "\n"
