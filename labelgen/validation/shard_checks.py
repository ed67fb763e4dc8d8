"""Tar files of frames, read with Python's own reader, against the lists beside them."""

from __future__ import annotations

from collections.abc import Iterator

from datasets_manifest.storage.layout import shard_file, shard_index_file
from datasets_manifest.storage.shard_index import index_of_archive, read_pairs_per_tar, read_shard_index, shard_numbers
from datasets_manifest.storage.storage import Storage


def shard_faults(storage: Storage) -> Iterator[tuple[str, list[str]]]:
    """What is wrong with each tar file of a dataset, under the name of the check; nothing where it has none.

    That the files in them are those of the records is checked frame by frame.
    """
    try:
        pairs_per_tar = read_pairs_per_tar(storage)
    except ValueError as error:
        yield "tar files", [str(error)]
        return
    if pairs_per_tar is None:
        return
    for number in shard_numbers(storage):
        yield "tar files", _faults(storage, number, pairs_per_tar)


def _faults(storage: Storage, number: int, pairs_per_tar: int) -> list[str]:
    where = storage.where(shard_file(number))
    try:
        listed = read_shard_index(storage, number)
    except ValueError as error:
        return [str(error)]
    try:
        with storage.open(shard_file(number)) as stream:
            found = index_of_archive(stream)
    except ValueError as error:
        return [f"{where}: {error}"]
    except OSError as error:
        return [f"{where}: cannot be read: {error.strerror}"]
    faults = []
    if found != listed:
        faults.append(f"{storage.where(shard_index_file(number))}: is not the list of {where}, which was changed")
    stray = sorted(index for index in found.frames if index // pairs_per_tar != number)
    if stray:
        faults.append(f"{where}: frame {stray[0]} belongs to another tar file")
    return faults
