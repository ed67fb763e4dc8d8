"""Tar shards for the `webdataset` package, with a sample for each stereo pair: images, part ids and the record.

A sample's key is the pair's index; its files are those of the frame's folder with the key before their names, such as
`000123.left.png`, and `000123.json`: the record, its split and the hash of the dataset.
"""

from __future__ import annotations

import io
import tarfile
from contextlib import ExitStack
from pathlib import Path

from datasets_manifest.atomic import new_folder
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.storage.writer import canonical_json
from datasets_manifest.types.records import PairRecord
from labelgen.export.export_log import ExportLog

SHARD_BYTES = 500_000_000
"""A shard ends before it would grow beyond this, unless one sample is larger."""


def write_webdataset(dataset: Location, out: Path, log: ExportLog, shard_bytes: int = SHARD_BYTES) -> list[Path]:
    """Write `SPLIT-NNNNNN.tar`.

    Args:
        dataset: the dataset's folder.
        out: new folder.
        log: receives the progress.
        shard_bytes: the largest size of a shard. [B]

    Returns:
        The shards, sorted.

    Raises:
        ValueError: the dataset cannot be read, or `out` is not empty.
        OSError: the folder cannot be written; nothing is left of it.
    """
    source = Dataset(dataset)
    splits = source.manifest.split_of_frame()
    writers: dict[str, _Shards] = {}
    # All shards are closed, even where closing one fails on a full disk.
    with new_folder(out) as folder, ExitStack() as open_shards:
        for split in sorted(set(splits.values())):
            writers[split] = _Shards(folder, split, shard_bytes)
            open_shards.callback(writers[split].close)
        for record in log.records(source):
            split = splits[record.frame_index]
            writers[split].add(_sample(source, record, split))
    return [out / name for split in sorted(writers) for name in writers[split].names]


def _sample(source: Dataset, record: PairRecord, split: str) -> dict[str, bytes]:
    """The files of a pair by their name in the archive."""
    key = f"{record.frame_index:06d}"
    label = {"split": split, "dataset_sha256": source.manifest.dataset_sha256, **record.model_dump(mode="json")}
    files = {f"{key}.json": canonical_json(label).encode()}
    for name in record.file_sha256:
        files[f"{key}.{name}"] = source.frames.read(record.frame_index, name)
    return files


class _Shards:
    """Numbered archives of one split, one of them open."""

    def __init__(self, folder: Path, split: str, shard_bytes: int) -> None:
        self._folder, self._split, self._limit = folder, split, shard_bytes
        self._archive: tarfile.TarFile | None = None
        self._size = 0
        self.names: list[str] = []

    def add(self, files: dict[str, bytes]) -> None:
        """Append a sample, which stays in one shard."""
        size = sum(tarfile.BLOCKSIZE + _in_blocks(len(data)) for data in files.values())
        if self._archive is None or self._size + size > self._limit:
            self.close()
            self.names.append(f"{self._split}-{len(self.names):06d}.tar")
            self._archive = tarfile.TarFile(self._folder / self.names[-1], "x", format=tarfile.USTAR_FORMAT)
            # Two empty blocks end an archive, which is filled up to a whole record.
            self._size = tarfile.RECORDSIZE
        for name in sorted(files):
            # Without owner and time stamp: the header depends on the sample alone.
            header = tarfile.TarInfo(name)
            header.size, header.mode = len(files[name]), 0o644
            self._archive.addfile(header, io.BytesIO(files[name]))
        self._size += size

    def close(self) -> None:
        """End the open shard."""
        if self._archive is not None:
            self._archive.close()
            self._archive = None


def _in_blocks(size_bytes: int) -> int:
    """Size in whole blocks of a tar archive. [B]"""
    return -(-size_bytes // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE
