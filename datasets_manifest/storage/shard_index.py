"""What lies where in a tar file of frames: read from the list beside it, or from the archive itself."""

from __future__ import annotations

import hashlib
import json
import tarfile
from typing import IO, Annotated, Any, BinaryIO, Literal, NamedTuple, Self, cast

from pydantic import Field, ValidationError, model_validator

from datasets_manifest.storage.layout import (
    RECORD_FILE,
    SHARDS_FILE,
    SHARDS_FOLDER,
    is_plain_name,
    shard_file,
    shard_index_file,
)
from datasets_manifest.storage.storage import Storage
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
