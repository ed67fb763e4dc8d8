"""Where the files of a dataset's frames lie: in a folder for each frame, or many frames in a tar file."""

from __future__ import annotations

from functools import cached_property, partial
from pathlib import Path
from threading import Lock

from datasets_manifest.storage.layout import (
    FRAMES_FOLDER,
    RECORD_FILE,
    frame_name,
    is_plain_name,
    shard_file,
)
from datasets_manifest.storage.shard_index import (
    ShardIndex,
    member_name,
    read_pairs_per_tar,
    read_shard_index,
    shard_numbers,
)
from datasets_manifest.storage.storage import Location, in_order, open_storage

# A list of 1000 frames takes some 2 MB of memory.
_LISTS_KEPT = 64
# Requests run in threads. It is not the store's own: a store is pickled for the processes of data loaders.
_LISTS_LOCK = Lock()


class FrameStore:
    """Reads frames of one dataset; a frame with a folder of its own has been made since its tar file was packed."""

    def __init__(self, dataset: Location) -> None:
        """Look how a dataset keeps its frames.

        Raises:
            ValueError: a URL that cannot be used, or a damaged list of tar files.
        """
        self.storage = open_storage(dataset)
        self.pairs_per_tar = read_pairs_per_tar(self.storage)
        self._shards: dict[int, ShardIndex] = {}

    def indices(self) -> list[int]:
        """Indices of the frames that are there, ascending.

        Raises:
            ValueError: a list of tar files is missing or damaged; names the file.
        """
        found = set(self.staged)
        if self.pairs_per_tar is not None:
            read = partial(read_shard_index, self.storage)
            for shard in in_order(read, shard_numbers(self.storage), self.storage):
                found.update(shard.frames)
        return sorted(found)

    @cached_property
    def staged(self) -> frozenset[int]:
        """Indices of the frames that have folders of their own."""
        folders = self.storage.folders_with(FRAMES_FOLDER, RECORD_FILE)
        return frozenset(int(name) for name in folders if name.isdecimal())

    def names(self, frame_index: int) -> list[str]:
        """Names of the files of a frame, sorted.

        Raises:
            ValueError: a list of tar files is missing or damaged.
        """
        shard = self._shard_of(frame_index)
        return self.storage.names(frame_name(frame_index)) if shard is None else sorted(shard.frames[frame_index])

    def where(self, frame_index: int, name: str = "") -> str:
        """What to call a file of a frame, or the frame, in messages."""
        if self._is_packed(frame_index):
            tar = shard_file(frame_index // (self.pairs_per_tar or 1))
            return self.storage.where(f"{tar}/{member_name(frame_index, name) if name else f'{frame_index:06d}'}")
        folder = frame_name(frame_index)
        return self.storage.where(f"{folder}/{name}" if name else folder)

    def read(self, frame_index: int, name: str) -> bytes:
        """A file of a frame.

        Raises:
            ValueError: it is missing, leads elsewhere or cannot be read; names the file.
        """
        path = f"{frame_name(frame_index)}/{name}"
        try:
            if not is_plain_name(name) or self.storage.leads_outside(path):
                raise ValueError(f"{self.where(frame_index, name)}: leads outside the frame's folder")
            shard = self._shard_of(frame_index)
            if shard is None:
                return self.storage.read(path)
            file = shard.frames[frame_index].get(name)
            if file is None:
                raise FileNotFoundError
            tar = shard_file(frame_index // (self.pairs_per_tar or 1))
            return self.storage.read(tar, file.offset, file.size)
        except FileNotFoundError as error:
            raise ValueError(f"{self.where(frame_index, name)}: is missing") from error
        except OSError as error:
            raise ValueError(f"{self.where(frame_index, name)}: cannot be read: {error}") from error

    def path(self, frame_index: int, name: str) -> Path | None:
        """The file of a frame itself, where it is one of this machine.

        Raises:
            ValueError: it is missing or leads elsewhere; names the file.
        """
        inside = f"{frame_name(frame_index)}/{name}"
        path = None if self._is_packed(frame_index) else self.storage.path(inside)
        if path is None:
            return None
        if not is_plain_name(name) or path.is_symlink() or self.storage.leads_outside(inside):
            raise ValueError(f"{path}: leads outside the frame's folder")
        if not path.is_file():
            raise ValueError(f"{path}: is missing")
        return path

    def _is_packed(self, frame_index: int) -> bool:
        return self.pairs_per_tar is not None and frame_index not in self.staged

    def _shard_of(self, frame_index: int) -> ShardIndex | None:
        """The list of the tar file that a frame lies in, or None where it has a folder, or is nowhere."""
        if not self._is_packed(frame_index) or self.pairs_per_tar is None:
            return None
        shard = self._shard(frame_index // self.pairs_per_tar)
        return shard if frame_index in shard.frames else None

    def _shard(self, number: int) -> ShardIndex:
        """The list of a tar file; those that were read last are kept."""
        with _LISTS_LOCK:
            shard = self._shards.pop(number, None) or read_shard_index(self.storage, number)
            self._shards[number] = shard
            if len(self._shards) > _LISTS_KEPT:
                del self._shards[next(iter(self._shards))]
        return shard


def frames_there(dataset: Location) -> list[int]:
    """Indices of the frames that are in a dataset, ascending.

    Raises:
        ValueError: a list of tar files is missing or damaged; names the file.
    """
    return FrameStore(dataset).indices()
