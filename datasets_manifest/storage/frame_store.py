"""Access to the files of a dataset's frames, in a folder for each frame or in tar files of many frames."""

from __future__ import annotations

import hashlib
import json
import tarfile
from functools import cached_property, partial
from pathlib import Path
from threading import Lock
from typing import IO, Annotated, Any, BinaryIO, Literal, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator

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
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain

MAX_PAIRS_PER_TAR = 100_000

_BLOCK_BYTES = 2**20

# The index of a tar file of 1000 frames takes some 2 MB of memory.
_MAX_CACHED_INDICES = 64

# Reads run in threads. The lock is global, because stores are pickled for the processes of data loaders.
_CACHE_LOCK = Lock()


class FrameStore:
    """Reads frames of one dataset; a frame's folder, where it exists, takes precedence over its tar file."""

    def __init__(self, dataset: Location) -> None:
        """Open a dataset in either layout.

        Raises:
            ValueError: a URL that cannot be used, or a damaged `shards/layout.json`.
        """
        self.storage = open_storage(dataset)
        self.pairs_per_tar = read_pairs_per_tar(self.storage)
        self._shards: dict[int, ShardIndex] = {}

    def indices(self) -> list[int]:
        """Indices of the stored frames, ascending.

        Raises:
            ValueError: a list of tar files is missing or damaged; names the file.
        """
        found = set(self.staged)
        if self.pairs_per_tar is not None:
            read = partial(read_shard_index, self.storage)
            for shard in map_in_order(read, shard_numbers(self.storage), self.storage):
                found.update(shard.frames)
        return sorted(found)

    @cached_property
    def staged(self) -> frozenset[int]:
        """Indices of the frames that have folders of their own."""
        folders = self.storage.folders_with(FRAMES_FOLDER, RECORD_FILE)
        return frozenset(index for index in map(frame_of_name, folders) if index is not None)

    def names(self, frame_index: int) -> list[str]:
        """Names of the files of a frame, sorted.

        Raises:
            ValueError: a list of tar files is missing or damaged.
        """
        shard = self._shard_of(frame_index)
        return self.storage.names(frame_name(frame_index)) if shard is None else sorted(shard.frames[frame_index])

    def where(self, frame_index: int, name: str = "") -> str:
        """Path or URL of a file of a frame, or of the frame, for messages."""
        if self._is_packed(frame_index):
            tar = shard_file(frame_index // (self.pairs_per_tar or 1))
            return self.storage.where(f"{tar}/{member_name(frame_index, name) if name else f'{frame_index:06d}'}")
        folder = frame_name(frame_index)
        return self.storage.where(f"{folder}/{name}" if name else folder)

    def read(self, frame_index: int, name: str) -> bytes:
        """A file of a frame.

        Raises:
            ValueError: it is missing, leads out of the frame's folder or cannot be read; names the file.
        """
        path = f"{frame_name(frame_index)}/{name}"
        try:
            if not is_plain_name(name) or self.storage.leads_outside(path):
                raise ValueError(f"{self.where(frame_index, name)}: leads outside the frame's folder")
            shard = self._shard_of(frame_index)
            if shard is None:
                return self.storage.read_inside(path)
            file = shard.frames[frame_index].get(name)
            if file is None:
                raise FileNotFoundError
            tar = shard_file(frame_index // (self.pairs_per_tar or 1))
            return self.storage.read(tar, file.offset, file.size)
        except FileNotFoundError as error:
            raise ValueError(f"{self.where(frame_index, name)}: is missing") from error
        except OSError as error:
            raise ValueError(f"{self.where(frame_index, name)}: cannot be read: {error.strerror or error}") from error

    def path(self, frame_index: int, name: str) -> Path | None:
        """Path of a file of a frame, or None where it is remote or inside a tar file.

        Raises:
            ValueError: it is missing or leads out of the frame's folder; names the file.
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
        """Index of the tar file that holds a frame, or None where the frame has a folder or does not exist."""
        if not self._is_packed(frame_index) or self.pairs_per_tar is None:
            return None
        shard = self._shard(frame_index // self.pairs_per_tar)
        return shard if frame_index in shard.frames else None

    def _shard(self, number: int) -> ShardIndex:
        """Index of a tar file; the most recently used are cached."""
        with _CACHE_LOCK:
            shard = self._shards.pop(number, None) or read_shard_index(self.storage, number)
            self._shards[number] = shard
            if len(self._shards) > _MAX_CACHED_INDICES:
                del self._shards[next(iter(self._shards))]
        return shard


def list_frames(dataset: Location) -> list[int]:
    """Indices of the frames that a dataset holds, ascending.

    Raises:
        ValueError: a list of tar files is missing or damaged; names the file.
    """
    return FrameStore(dataset).indices()


class ShardLayout(FrozenModel):
    """`shards/layout.json`, which says that a dataset keeps its frames in tar files of that many pairs."""

    schema_version: Literal[1] = 1
    pairs_per_tar: int = Field(ge=1, le=MAX_PAIRS_PER_TAR)


class PackedFile(NamedTuple):
    """Position, size and hash of a file within an archive. [bytes]"""

    offset: Annotated[int, Field(ge=0)]
    size: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

    @property
    def end(self) -> int:
        """Offset of its end. [bytes]"""
        return self.offset + self.size


class ShardIndex(FrozenModel):
    """`shards/NNNNNN.json`, the index beside a tar file.

    Attributes:
        size, sha256: of the tar file. [bytes]
        frames: the files of each frame by name.
    """

    schema_version: Literal[1] = 1
    size: int = Field(ge=0)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")
    frames: dict[int, dict[str, PackedFile]]

    @model_validator(mode="after")
    def _possible(self) -> Self:
        for frame_index, files in self.frames.items():
            if frame_index < 0 or RECORD_FILE not in files or not all(map(is_plain_name, files)):
                raise ValueError(f"frames: frame {frame_index} must have plain file names and a {RECORD_FILE}")
            if max(file.end for file in files.values()) > self.size:
                raise ValueError(f"frames: frame {frame_index} reaches beyond the end of the tar file")
        return self


def read_pairs_per_tar(storage: Storage) -> int | None:
    """Number of frames in each tar file of a dataset, or None where every frame has a folder.

    Raises:
        ValueError: `shards/layout.json` is damaged.
    """
    try:
        data = storage.read(SHARDS_FILE)
    except (FileNotFoundError, NotADirectoryError):
        return None
    try:
        return ShardLayout.model_validate_json(data).pairs_per_tar
    except ValidationError as error:
        raise ValueError(f"{storage.where(SHARDS_FILE)}: {explain(error)}") from error


def shard_numbers(storage: Storage) -> list[int]:
    """Numbers of the stored tar files, ascending."""
    names = storage.names(SHARDS_FOLDER)
    found = (frame_of_name(name[:-4]) for name in names if name.endswith(".tar"))
    return sorted(number for number in found if number is not None)


def read_shard_index(storage: Storage, number: int) -> ShardIndex:
    """The index beside a tar file.

    Raises:
        ValueError: it is missing or damaged, or belongs to another tar file; names the file.
    """
    name = shard_index_file(number)
    where = storage.where(name)
    try:
        index = ShardIndex.model_validate_json(storage.read(name))
        size = storage.size(shard_file(number))
    except FileNotFoundError as error:
        missing = name if not storage.exists(name) else shard_file(number)
        raise ValueError(f"{storage.where(missing)}: is missing; render the recipe again to repair it") from error
    except ValidationError as error:
        raise ValueError(f"{where}: {explain(error)}; delete it and render the recipe again to repair it") from error
    except OSError as error:
        raise ValueError(f"{where}: cannot be read: {error.strerror}") from error
    if size != index.size:
        raise ValueError(
            f"{where}: is of a tar file of {index.size} bytes, but that has {size}; delete it and render the recipe "
            "again to mend it"
        )
    return index


def index_of_archive(stream: BinaryIO) -> ShardIndex:
    """The index of a tar file from the archive itself, which is read once from beginning to end.

    Raises:
        ValueError: it is not an archive of frames, or damaged.
        OSError: it cannot be read.
    """
    frames: dict[int, dict[str, PackedFile]] = {}
    hashed = _HashedStream(stream)
    try:
        # Header by header, for the library believes extension headers of any size, which archives of frames lack.
        while any(header := hashed.read(tarfile.BLOCKSIZE)):
            member, start = tarfile.TarInfo.frombuf(header, tarfile.ENCODING, "surrogateescape"), hashed.size
            key, _, name = member.name.partition(".")
            frame_index = frame_of_name(key)
            if member.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or member.size < 0 or frame_index is None:
                raise ValueError(f"holds {member.name}, which is not a file of a frame")
            frames.setdefault(frame_index, {})[name] = PackedFile(start, member.size, _hash_member(hashed, member.size))
        if not hashed.size:
            raise tarfile.ReadError("empty file")
    except tarfile.TarError as error:
        raise ValueError(f"is not a complete tar file: {error}") from error
    while hashed.read(_BLOCK_BYTES):
        pass
    try:
        return ShardIndex(size=hashed.size, sha256=hashed.digest.hexdigest(), frames=frames)
    except ValidationError as error:
        raise ValueError(explain(error)) from error


def _hash_member(stream: _HashedStream, size_bytes: int) -> str:
    """Hash of the next file of an archive, after which the stream is at the next header.

    Raises:
        ReadError: of `tarfile`; the stream ends within the file.
    """
    digest, left = hashlib.sha256(), size_bytes
    while left:
        if not (block := stream.read(min(left, _BLOCK_BYTES))):
            raise tarfile.ReadError("unexpected end of data")
        digest.update(block)
        left -= len(block)
    stream.read(-size_bytes % tarfile.BLOCKSIZE)
    return digest.hexdigest()


class _HashedStream:
    """A stream that counts and hashes the bytes that are read from it."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self.size, self.digest = stream, 0, hashlib.sha256()

    def read(self, size: int) -> bytes:
        """The next bytes; empty at the end."""
        block = self._stream.read(size)
        self.size += len(block)
        self.digest.update(block)
        return block


def sha256_of(stream: IO[bytes]) -> str:
    """Hash of the rest of a stream."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK_BYTES):
        digest.update(block)
    return digest.hexdigest()


def member_name(frame_index: int, name: str) -> str:
    """Name of a frame's file within an archive, by which the `webdataset` package groups samples."""
    return f"{frame_index:06d}.{name}"


def index_text(index: ShardIndex) -> str:
    """JSON text of the index, with a line for each frame."""
    table: dict[str, Any] = index.model_dump(mode="json")
    frames = table.pop("frames")
    head = _compact(table).removesuffix("}")
    lines = ",\n".join(f'"{key}":{_compact(files)}' for key, files in frames.items())
    return f'{head},"frames":{{\n{lines}\n}}}}\n'


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
