"""Packs finished frames into tar files, so that a run that is killed at any instant loses no frame.

A frame is first written into a folder of its own. Once all frames of a tar file exist, the archive is written and
appears whole; then the index beside it; and only then are the folders removed. An archive without an index gets a new
one from `repair_shards`.
"""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import BinaryIO

from datasets_manifest.storage.frame_store import (
    MAX_PAIRS_PER_TAR,
    FrameStore,
    PackedFile,
    ShardIndex,
    ShardLayout,
    index_of_archive,
    index_text,
    member_name,
    read_pairs_per_tar,
    read_shard_index,
    sha256_of,
    shard_numbers,
)
from datasets_manifest.storage.layout import (
    FRAMES_FOLDER,
    RECORD_FILE,
    SHARDS_FILE,
    SHARDS_FOLDER,
    frame_name,
    frame_of_name,
    is_plain_name,
    shard_file,
    shard_index_file,
)
from datasets_manifest.storage.storage import Location, Storage, map_in_order, open_storage
from drogue_models.untrusted_files import parse_json

Contents = list[tuple[str, bytes]]
Packed = Mapping[str, PackedFile]


@dataclass(frozen=True)
class Packing:
    """How frames are grouped into tar files.

    Attributes:
        pairs_per_tar: frame i belongs to tar file i // pairs_per_tar.
        frames: all frames that are to be made; a tar file is complete once it holds those that belong to it.
    """

    pairs_per_tar: int
    frames: range

    def members(self, number: int) -> set[int]:
        """Frames of one tar file."""
        first = number * self.pairs_per_tar
        return {index for index in range(first, first + self.pairs_per_tar) if index in self.frames}


def configure_packing(dataset: Location, pairs_per_tar: int | None) -> None:
    """Make a dataset keep its frames in tar files; frames that it already has are packed when a run ends.

    Args:
        dataset: its location.
        pairs_per_tar: pairs in each tar file; None leaves the dataset as it is.

    Raises:
        ValueError: it has tar files with another number of pairs already.
        OSError: it cannot be written.
    """
    if pairs_per_tar is None:
        return
    check_pairs_per_tar(pairs_per_tar)
    storage = open_storage(dataset)
    present = read_pairs_per_tar(storage)
    if present is None:
        text = ShardLayout(pairs_per_tar=pairs_per_tar).model_dump_json() + "\n"
        storage.write(SHARDS_FILE, text.encode())
    elif present != pairs_per_tar:
        raise ValueError(
            f"--tar: {storage.where()} has tar files of {present} pairs, got {pairs_per_tar}; leave it out, or render "
            "into a new folder"
        )


def check_pairs_per_tar(pairs_per_tar: int | None) -> None:
    """Check a number of pairs for a tar file; None, which leaves a dataset as it is, is valid.

    Raises:
        ValueError: it is out of range.
    """
    if pairs_per_tar is not None and not 1 <= pairs_per_tar <= MAX_PAIRS_PER_TAR:
        raise ValueError(f"--tar: must be from 1 to {MAX_PAIRS_PER_TAR} pairs, got {pairs_per_tar}")


def read_packing(dataset: Location, frames: range) -> Packing | None:
    """How a dataset packs the frames that are made, or None where each keeps its folder.

    Raises:
        ValueError: `shards/layout.json` is damaged.
    """
    pairs_per_tar = read_pairs_per_tar(open_storage(dataset))
    return None if pairs_per_tar is None else Packing(pairs_per_tar, frames)


class _IncompleteFrameError(Exception):
    """A frame's folder is damaged, or another process has packed it and is removing it."""


def pack_if_complete(dataset: Location, frame_index: int, packing: Packing) -> None:
    """Write the tar file that a frame belongs to, if that frame was the last one missing.

    Several processes may do so at once, as they write the same bytes. What cannot be packed is left to `pack_all`.

    Raises:
        OSError: it cannot be read or written.
    """
    storage = open_storage(dataset)
    number = frame_index // packing.pairs_per_tar
    wanted = packing.members(number)
    # The cheaper test first: it also counts folders that are still incomplete.
    if not wanted <= _indices(storage.names(FRAMES_FOLDER)):
        return
    staged = _indices(storage.folders_with(FRAMES_FOLDER, RECORD_FILE))
    if not wanted <= staged or storage.exists(shard_file(number)):
        return
    try:
        _pack(storage, number, _all_staged(storage, sorted(wanted)))
    except _IncompleteFrameError:
        return
    _remove_folders(storage, wanted)


def pack_all(dataset: Location) -> None:
    """Pack all frames that still have folders, also into incomplete tar files; only while no other process writes.

    Damaged frames keep their folders.

    Raises:
        ValueError: the index of a tar file is missing or damaged; names it.
        OSError: it cannot be read or written.
    """
    store = FrameStore(dataset)
    if store.pairs_per_tar is None:
        return
    present = set(shard_numbers(store.storage))
    for number, staged in _by_tar_file(store.staged, store.pairs_per_tar).items():
        packed = read_shard_index(store.storage, number).frames if number in present else {}
        _pack_again(store.storage, number, staged, packed)


def remove_packed(dataset: Location, frame_indices: Collection[int]) -> None:
    """Write tar files anew without some of their frames; only while no other process writes into the dataset.

    Raises:
        ValueError: the index of a tar file is missing or damaged; names it.
        OSError: it cannot be read or written.
    """
    storage = open_storage(dataset)
    pairs_per_tar = read_pairs_per_tar(storage)
    if pairs_per_tar is None:
        return
    for number, removed in _by_tar_file(frame_indices, pairs_per_tar).items():
        packed = read_shard_index(storage, number).frames
        left = sorted({*packed} - {*removed})
        if left:
            _pack(storage, number, _all_packed(storage, number, {index: packed[index] for index in left}))
        else:
            storage.delete(shard_index_file(number))
            storage.delete(shard_file(number))


def repair_shards(dataset: Location) -> None:
    """Rebuild the indices that killed runs did not write; only while no other process writes into the dataset.

    Raises:
        ValueError: a tar file is damaged; names it.
        OSError: it cannot be read or written.
    """
    storage = open_storage(dataset)
    if read_pairs_per_tar(storage) is None:
        return
    names = set(storage.names(SHARDS_FOLDER))
    for number in shard_numbers(storage):
        if f"{number:06d}.json" in names:
            continue
        try:
            with storage.open(shard_file(number)) as stream:
                index = index_of_archive(stream)
        except ValueError as error:
            where = storage.where(shard_file(number))
            raise ValueError(
                f"{where}: {error}; delete it and run the same command to make its frames again"
            ) from error
        storage.write(shard_index_file(number), index_text(index).encode())


def _indices(names: list[str]) -> set[int]:
    return {index for index in map(frame_of_name, names) if index is not None}


def _by_tar_file(frame_indices: Iterable[int], pairs_per_tar: int) -> dict[int, list[int]]:
    """Frames by the number of their tar file, ascending."""
    found: dict[int, list[int]] = {}
    for frame_index in sorted(frame_indices):
        found.setdefault(frame_index // pairs_per_tar, []).append(frame_index)
    return found


def _pack_again(storage: Storage, number: int, staged: list[int], packed: Mapping[int, Packed]) -> None:
    """Write a tar file anew, with the undamaged frames that have folders and those that it already holds."""
    if all(index in packed for index in staged) and all(
        map_in_order(partial(_is_known, storage, number, packed), staged, storage)
    ):
        _remove_folders(storage, staged)
        return
    waiting, whole = set(staged), list[int]()

    def files_of(index: int) -> tuple[Contents | None, Contents | None]:
        files = _staged_files(storage, index) if index in waiting else None
        # A frame that is damaged in the tar file and was not made again is dropped from the dataset.
        return files, _packed_files(storage, number, packed[index]) if files is None and index in packed else None

    def contents() -> Iterator[tuple[int, Contents]]:
        indices = sorted({*packed, *waiting})
        for index, (mine, before) in zip(indices, map_in_order(files_of, indices, storage), strict=True):
            if mine is not None:
                whole.append(index)
            files = mine or before
            if files is not None:
                yield index, files
        if not whole:
            raise _IncompleteFrameError

    with suppress(_IncompleteFrameError):
        _pack(storage, number, contents())
        _remove_folders(storage, whole)


def _is_known(storage: Storage, number: int, packed: Mapping[int, Packed], frame_index: int) -> bool:
    """Whether a frame's folder is undamaged and equal to its copy in the tar file."""
    files = _staged_files(storage, frame_index)
    return files is not None and files == _packed_files(storage, number, packed[frame_index])


def _all_staged(storage: Storage, indices: Sequence[int]) -> Iterator[tuple[int, Contents]]:
    """Frames that have folders, with their files; only a few are in memory at a time.

    Raises:
        _IncompleteFrameError: one is damaged.
    """
    contents = map_in_order(partial(_staged_files, storage), indices, storage)
    for index, files in zip(indices, contents, strict=True):
        if files is None:
            raise _IncompleteFrameError
        yield index, files


def _all_packed(storage: Storage, number: int, packed: Mapping[int, Packed]) -> Iterator[tuple[int, Contents]]:
    """The undamaged frames of a tar file, with their files; only a few are in memory at a time."""
    contents = map_in_order(lambda index: _packed_files(storage, number, packed[index]), packed, storage)
    return ((index, files) for index, files in zip(packed, contents, strict=True) if files is not None)


def _staged_files(storage: Storage, frame_index: int) -> Contents | None:
    """The files in a frame's folder, sorted, or None where they do not match the hashes of its record."""
    folder = frame_name(frame_index)
    try:
        record = storage.read(f"{folder}/{RECORD_FILE}")
        hashes: dict[str, str] = parse_json(record)["file_sha256"]
        files = {name: storage.read(f"{folder}/{name}") for name in hashes if is_plain_name(name)}
    except (FileNotFoundError, ValueError, KeyError, TypeError, RecursionError):
        return None
    if {name: hashlib.sha256(data).hexdigest() for name, data in files.items()} != hashes:
        return None
    return sorted({**files, RECORD_FILE: record}.items())


def _packed_files(storage: Storage, number: int, files: Packed) -> Contents | None:
    """The files of a frame in a tar file, sorted, or None where they do not match the hashes of the index."""
    found = [(name, storage.read(shard_file(number), file.offset, file.size)) for name, file in sorted(files.items())]
    same = all(hashlib.sha256(data).hexdigest() == files[name].sha256 for name, data in found)
    return found if same else None


def _pack(storage: Storage, number: int, frames: Iterable[tuple[int, Contents]]) -> None:
    with storage.write_large(shard_file(number)) as stream:
        index = _write_archive(frames, stream)
        # An index must never stand beside another archive.
        storage.delete(shard_index_file(number))
    storage.write(shard_index_file(number), index_text(index).encode())


def _write_archive(frames: Iterable[tuple[int, Contents]], stream: BinaryIO) -> ShardIndex:
    """Write a tar file whose bytes depend on its frames alone: without owners and time stamps."""
    lists: dict[int, dict[str, PackedFile]] = {}
    with tarfile.TarFile(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for frame_index, contents in frames:
            lists[frame_index] = {}
            for name, data in contents:
                header = tarfile.TarInfo(member_name(frame_index, name))
                header.size, header.mode = len(data), 0o644
                place = PackedFile(archive.offset + tarfile.BLOCKSIZE, len(data), hashlib.sha256(data).hexdigest())
                archive.addfile(header, io.BytesIO(data))
                lists[frame_index][name] = place
    size = stream.tell()
    stream.seek(0)
    return ShardIndex(size=size, sha256=sha256_of(stream), frames=lists)


def _remove_folders(storage: Storage, indices: Iterable[int]) -> None:
    for _ in map_in_order(lambda index: storage.delete_folder(frame_name(index), RECORD_FILE), indices, storage):
        pass
