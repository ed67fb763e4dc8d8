"""Where a dataset lies: a folder of this machine, or any place that fsspec knows, behind one small interface."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import BinaryIO, Protocol, TextIO, TypeVar, cast

from datasets_manifest.atomic import (
    PART_SUFFIX,
    open_bytes_atomic,
    open_text_atomic,
    part_path,
    sync_folder,
    write_bytes_atomic,
)
from datasets_manifest.storage.remote_storage import RemoteStorage


class LocalStorage:
    """Files below a folder; see `datasets_manifest.storage.storage.Storage`."""

    is_remote = False

    def __init__(self, root: Path) -> None:
        self._root = root

    def where(self, name: str = "") -> str:
        """The path."""
        return str(self._root / name)

    def path(self, name: str) -> Path | None:
        """The file itself."""
        return self._root / name

    def is_there(self) -> bool:
        """Whether the folder is there."""
        return self._root.is_dir()

    def exists(self, name: str) -> bool:
        """Whether there is a file of that name."""
        return (self._root / name).is_file()

    def leads_outside(self, name: str) -> bool:
        """Whether the file is a link that leads out of its folder."""
        path = self._root / name
        # Links are few, and to follow every part of a path takes as long as to read a small file.
        return path.is_symlink() and Path(os.path.realpath(path)).parent != Path(os.path.realpath(path.parent))

    def size(self, name: str) -> int:
        """Of a file. [bytes]"""
        return (self._root / name).stat().st_size

    def read(self, name: str, offset: int = 0, size: int | None = None) -> bytes:
        """A file or a part of it."""
        if offset == 0 and size is None:
            return (self._root / name).read_bytes()
        with (self._root / name).open("rb") as stream:
            stream.seek(offset)
            return stream.read(size)

    def open(self, name: str) -> AbstractContextManager[BinaryIO]:
        """The file itself."""
        return (self._root / name).open("rb")

    @contextmanager
    def local_copy(self, name: str) -> Iterator[Path]:
        """The file itself."""
        yield self._root / name

    def names(self, folder: str) -> list[str]:
        """What lies directly in a folder."""
        try:
            return sorted(entry.name for entry in os.scandir(self._root / folder))
        except (FileNotFoundError, NotADirectoryError):
            return []

    def files_ending(self, suffix: str) -> list[str]:
        """All files at any depth that end so."""
        found = self._root.rglob(f"*{suffix}")
        return sorted(
            path.relative_to(self._root).as_posix() for path in found if path.is_file() and not path.is_symlink()
        )

    def folders_with(self, folder: str, mark: str) -> list[str]:
        """Folders that hold the file `mark`."""
        return [name for name in self.names(folder) if (self._root / folder / name / mark).is_file()]

    def leftovers(self, folder: str, mark: str) -> list[str]:
        """What is still called as only unfinished things are; folders with a mark appear with all their files."""
        folders = [name for name in self.names("") if not name.startswith(".") and (self._root / name).is_dir()]
        return sorted(
            f"{place}/{name}".lstrip("/")
            for place in ["", *folders]
            for name in self.names(place)
            if name.startswith(".") and name.endswith(PART_SUFFIX)
        )

    def write(self, name: str, data: bytes) -> None:
        """Write or replace a file by one rename."""
        write_bytes_atomic(self._root / name, data)

    def write_text(self, name: str) -> AbstractContextManager[TextIO]:
        """Text by one rename."""
        return open_text_atomic(self._root / name)

    def write_large(self, name: str) -> AbstractContextManager[BinaryIO]:
        """Bytes by one rename."""
        return open_bytes_atomic(self._root / name)

    def spool(self, folder: str) -> TextIO:
        """A file without a name on the disk of the folder, not in memory as /tmp is on many machines."""
        place = self._root / folder
        place.mkdir(parents=True, exist_ok=True)
        return cast(TextIO, tempfile.TemporaryFile("w+", encoding="utf-8", newline="\n", dir=place))

    def write_together(self, folder: str, files: Mapping[str, bytes], mark: str) -> None:
        """All files beside the folder first, then one rename."""
        target = self._root / folder
        part = part_path(target)
        try:
            part.mkdir(parents=True)
            for name in sorted(files):
                _write_synced(part / name, files[name])
            sync_folder(part)
            self._bury(target)
            part.rename(target)
            sync_folder(target.parent)
        except OSError as error:
            raise OSError(error.errno, f"{target}: cannot be written: {error.strerror}") from error
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def delete(self, name: str) -> None:
        """Remove a file or, of what killed runs have left, a folder."""
        path = self._root / name
        try:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise OSError(error.errno, f"{path}: cannot be removed: {error.strerror}") from error

    def delete_folder(self, folder: str, mark: str) -> None:
        """By one rename before anything in it is deleted."""
        self._bury(self._root / folder)

    def _bury(self, target: Path) -> None:
        if not target.exists():
            return
        grave = part_path(target)
        target.rename(grave)
        shutil.rmtree(grave)


def _write_synced(path: Path, data: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


Location = Path | str
"""A folder, or a URL such as `s3://bucket/name`; text without `://` is a folder too."""

T = TypeVar("T")
R = TypeVar("R")

# An answer takes some 50 ms to come, whatever its size; with so many under way the line is full.
_REQUESTS_AT_ONCE = 16


class Storage(Protocol):
    """Files by their name below one place: parts with `/` between them.

    What is missing raises `FileNotFoundError`, everything else that goes wrong an `OSError` of one line.

    Attributes:
        is_remote: whether every look at it is a request that takes its time.
    """

    is_remote: bool

    def where(self, name: str = "") -> str:
        """What to call a file in messages."""
        ...

    def path(self, name: str) -> Path | None:
        """The file itself where it is one of this machine, there or not."""
        ...

    def is_there(self) -> bool:
        """Whether the place itself is there."""
        ...

    def exists(self, name: str) -> bool:
        """Whether there is a file of that name."""
        ...

    def leads_outside(self, name: str) -> bool:
        """Whether the file is a link that leads out of its folder."""
        ...

    def size(self, name: str) -> int:
        """Of a file. [bytes]"""
        ...

    def read(self, name: str, offset: int = 0, size: int | None = None) -> bytes:
        """A file, or `size` bytes of it from `offset` on, fewer where it ends."""
        ...

    def open(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A stream of a large file, which can be read from any place."""
        ...

    def local_copy(self, name: str) -> AbstractContextManager[Path]:
        """A file of this machine with the contents, for libraries that open files themselves; not to be written."""
        ...

    def names(self, folder: str) -> list[str]:
        """What lies directly in a folder, sorted; nothing where there is none."""
        ...

    def files_ending(self, suffix: str) -> list[str]:
        """Names of all files at any depth that end so, sorted; links are not followed."""
        ...

    def folders_with(self, folder: str, mark: str) -> list[str]:
        """Names of the folders in a folder that hold the file `mark`, sorted."""
        ...

    def leftovers(self, folder: str, mark: str) -> list[str]:
        """Names of what killed runs left half-written, sorted; in folders of a folder `mark` tells what is whole."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Write or replace a file, which is there whole or not at all."""
        ...

    def write_text(self, name: str) -> AbstractContextManager[TextIO]:
        """A stream of UTF-8 text whose file is there when the block ends without an error."""
        ...

    def write_large(self, name: str) -> AbstractContextManager[BinaryIO]:
        """The same for bytes, any number of them; the stream can be read from any place too."""
        ...

    def spool(self, folder: str) -> TextIO:
        """A temporary file without a name, on the disk of the folder or on that for temporary files."""
        ...

    def write_together(self, folder: str, files: Mapping[str, bytes], mark: str) -> None:
        """Put a folder in place of what is there of that name: it counts only once `mark`, its last file, is there."""
        ...

    def delete(self, name: str) -> None:
        """Remove a file, if it is there."""
        ...

    def delete_folder(self, folder: str, mark: str) -> None:
        """Remove a folder, if it is there, so that it stops counting before anything else of it goes."""
        ...


def as_location(text: str) -> Location:
    """What a user names: a URL stays one, and anything else is a folder.

    Raises:
        ValueError: a URL that names nothing.
    """
    scheme, slashes, name = text.partition("://")
    if not slashes:
        return Path(text)
    if scheme == "file" and name:
        return Path(name)
    if not name.strip("/"):
        raise ValueError(f"{text}: names no place; give {scheme}://NAME")
    return text.rstrip("/")


def open_storage(location: Location) -> Storage:
    """The storage at a location; nothing is looked at yet.

    Raises:
        ValueError: a URL of a kind that is not known, or whose package is missing.
    """
    place = as_location(location) if isinstance(location, str) else location
    return RemoteStorage(place) if isinstance(place, str) else LocalStorage(place)


def join(location: Location, name: str) -> Location:
    """A place below another."""
    place = as_location(location) if isinstance(location, str) else location
    return f"{place}/{name}" if isinstance(place, str) else place / name


def absolute(location: Location) -> Location:
    """The same place for a process that works in another folder."""
    place = as_location(location) if isinstance(location, str) else location
    return place if isinstance(place, str) else place.resolve()


def in_order(function: Callable[[T], R], items: Iterable[T], storage: Storage) -> Iterator[R]:
    """`function` of each item, in their order; where every look takes its time, of several at once.

    Raises:
        Exception: what `function` raises, in its turn.
    """
    if not storage.is_remote:
        yield from map(function, items)
        return
    waiting: deque[Future[R]] = deque()
    with ThreadPoolExecutor(_REQUESTS_AT_ONCE) as threads:
        try:
            for item in items:
                waiting.append(threads.submit(function, item))
                if len(waiting) >= _REQUESTS_AT_ONCE:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
