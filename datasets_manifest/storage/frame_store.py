"""Where the files of a dataset's frames lie: in a folder for each frame, or many frames in a tar file."""

from __future__ import annotations

import hashlib
import json
import tarfile
from functools import cached_property, partial
from pathlib import Path
from threading import Lock
from typing import IO, Annotated, Any, BinaryIO, Literal, NamedTuple, Self, cast

from pydantic import Field, ValidationError, model_validator

from datasets_manifest.storage.layout import (
    FRAMES_FOLDER,
    RECORD_FILE,
    SHARDS_FILE,
    SHARDS_FOLDER,
    frame_name,
    is_plain_name,
    shard_file,
    shard_index_file,
)
from datasets_manifest.storage.storage import Location, Storage, in_order, open_storage
from drogue_models.frozen_model import FrozenModel
from drogue_models.presets import explain

MAX_PAIRS_PER_TAR = 100_000
_BLOCK_BYTES = 2**20


class ShardLayout(FrozenModel):
    """`shards/layout.json`: a dataset that has it keeps its frames in tar files, so many in each."""

    schema_version: Literal[1] = 1
    pairs_per_tar: int = Field(ge=1, le=MAX_PAIRS_PER_TAR)


class PackedFile(NamedTuple):
    """A file within an archive: from which byte on, how many bytes, and their hash."""

    offset: Annotated[int, Field(ge=0)]
    size: Annotated[int, Field(ge=0)]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

    @property
    def end(self) -> int:
        """Where it ends. [bytes]"""
        return self.offset + self.size


class ShardIndex(FrozenModel):
    """The list beside a tar file.

    Attributes:
        size, sha256: of the tar file. [bytes]
        frames: the files of each frame by their name.
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
    """How many frames the tar files of a dataset hold, or None where every frame has a folder.

    Raises:
        ValueError: the file that says so is damaged.
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
    """Numbers of the tar files that are there, ascending."""
    names = storage.names(SHARDS_FOLDER)
    return sorted(int(name[:-4]) for name in names if name.endswith(".tar") and name[:-4].isdecimal())


def read_shard_index(storage: Storage, number: int) -> ShardIndex:
    """The list beside a tar file.

    Raises:
        ValueError: it is missing or damaged, or not that of the tar file; names the file.
    """
    name = shard_index_file(number)
    where = storage.where(name)
    try:
        index = ShardIndex.model_validate_json(storage.read(name))
        size = storage.size(shard_file(number))
    except FileNotFoundError as error:
        missing = name if not storage.exists(name) else shard_file(number)
        raise ValueError(f"{storage.where(missing)}: is missing; render the recipe again to mend it") from error
    except ValidationError as error:
        raise ValueError(f"{where}: {explain(error)}; delete it and render the recipe again to mend it") from error
    except OSError as error:
        raise ValueError(f"{where}: cannot be read: {error.strerror}") from error
    if size != index.size:
        raise ValueError(
            f"{where}: is of a tar file of {index.size} bytes, but that has {size}; delete it and render the recipe "
            "again to mend it"
        )
    return index


def index_of_archive(stream: BinaryIO) -> ShardIndex:
    """The list of a tar file, from the archive itself, which is read once from its beginning to its end.

    Raises:
        ValueError: it is no archive of frames, or damaged.
        OSError: it cannot be read.
    """
    frames: dict[int, dict[str, PackedFile]] = {}
    hashed = _HashedStream(stream)
    try:
        with tarfile.open(fileobj=cast(IO[bytes], hashed), mode="r|", bufsize=_BLOCK_BYTES) as archive:
            for member in archive:
                key, _, name = member.name.partition(".")
                data = archive.extractfile(member)
                if data is None or not key.isdecimal():
                    raise ValueError(f"holds {member.name}, which is no file of a frame")
                digest = sha256_of(data)
                files = frames.setdefault(int(key), {})
                files[name] = PackedFile(member.offset_data, member.size, digest)
    except tarfile.TarError as error:
        raise ValueError(f"is no whole tar file: {error}") from error
    while hashed.read(_BLOCK_BYTES):
        pass
    try:
        return ShardIndex(size=hashed.size, sha256=hashed.digest.hexdigest(), frames=frames)
    except ValidationError as error:
        raise ValueError(explain(error)) from error


class _HashedStream:
    """A stream that is read once, with the number of bytes that were read and their hash."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self.size, self.digest = stream, 0, hashlib.sha256()

    def read(self, size: int) -> bytes:
        """The next bytes, none at its end."""
        block = self._stream.read(size)
        self.size += len(block)
        self.digest.update(block)
        return block


def sha256_of(stream: IO[bytes]) -> str:
    """Hash of what is left of a stream."""
    digest = hashlib.sha256()
    while block := stream.read(_BLOCK_BYTES):
        digest.update(block)
    return digest.hexdigest()


def member_name(frame_index: int, name: str) -> str:
    """A frame's file within an archive: the name by which the `webdataset` package puts a sample together."""
    return f"{frame_index:06d}.{name}"


def index_text(index: ShardIndex) -> str:
    """The list as it is written, with a line for each frame."""
    table: dict[str, Any] = index.model_dump(mode="json")
    frames = table.pop("frames")
    head = _compact(table).removesuffix("}")
    lines = ",\n".join(f'"{key}":{_compact(files)}' for key, files in frames.items())
    return f'{head},"frames":{{\n{lines}\n}}}}\n'


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


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
