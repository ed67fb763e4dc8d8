"""One interface to the two places where a dataset may lie: a local folder, or any URL that fsspec supports."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
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
from drogue_models.untrusted_files import MOST_BYTES, open_regular, read_regular

Location = Path | str
"""A folder, or a URL such as `s3://bucket/name`; text without `://` is a folder too."""

T = TypeVar("T")

R = TypeVar("R")

# A response takes some 50 ms regardless of its size; this many concurrent requests saturate the connection.
_CONCURRENT_REQUESTS = 16


class Storage(Protocol):
    """Files below one root, by names with `/` between folders.

    Missing files raise `FileNotFoundError`, all other failures an `OSError` of one line. Of local files only regular
    ones are read, and at most `MOST_BYTES` at a time.

    Attributes:
        is_remote: whether every access is a network request.
    """

    is_remote: bool

    def where(self, name: str = "") -> str:
        """Path or URL of a file, for messages."""
        ...

    def path(self, name: str) -> Path | None:
        """Path of a local file, whether it exists or not; None for remote storage."""
        ...

    def root_exists(self) -> bool:
        """Whether the root exists."""
        ...

    def exists(self, name: str) -> bool:
        """Whether there is a file of that name."""
        ...

    def leads_outside(self, name: str) -> bool:
        """Whether the file is a link that leads out of its folder."""
        ...

    def size(self, name: str) -> int:
        """Size of a file. [bytes]"""
        ...

    def read(self, name: str, offset: int = 0, size: int | None = None) -> bytes:
        """Contents of a file, or up to `size` bytes of it from `offset` on."""
        ...

    def read_inside(self, name: str) -> bytes:
        """Contents of a file, unless it is a link that leads out of its folder."""
        ...

    def open(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A seekable stream of a large file."""
        ...

    def names(self, folder: str) -> list[str]:
        """Names directly in a folder, sorted; empty for a missing folder."""
        ...

    def files_ending(self, suffix: str) -> list[str]:
        """Names of all files with the suffix, at any depth, sorted; links are not followed."""
        ...

    def folders_with(self, folder: str, mark: str) -> list[str]:
        """Names of the folders in a folder that hold the file `mark`, sorted."""
        ...

    def leftovers(self, folder: str, mark: str) -> list[str]:
        """Names of incomplete files and folders of killed runs, sorted; a folder is complete once it holds `mark`."""
        ...

    def write(self, name: str, data: bytes) -> None:
        """Write or replace a file atomically."""
        ...

    def write_text(self, name: str) -> AbstractContextManager[TextIO]:
        """A stream of UTF-8 text, whose file appears when the block ends without an error."""
        ...

    def write_large(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A seekable, readable stream of bytes, whose file appears when the block ends without an error."""
        ...

    def spool(self, folder: str) -> TextIO:
        """An unnamed temporary file, on the disk of the folder or among the system's temporary files."""
        ...

    def write_together(self, folder: str, files: Mapping[str, bytes], mark: str) -> None:
        """Write or replace a folder, which counts once its last file, `mark`, exists."""
        ...

    def delete(self, name: str) -> None:
        """Remove a file, if it exists."""
        ...

    def delete_folder(self, folder: str, mark: str) -> None:
        """Remove a folder, if it exists, in such an order that it stops counting first."""
        ...


def as_location(text: str) -> Location:
    """The location that a user named: a URL as text, anything else as the path of a folder.

    Raises:
        ValueError: an empty text, or a URL without a name.
    """
    if not text.strip():
        raise ValueError(f"place: must be a folder or a URL, got {text!r}")
    scheme, slashes, name = text.partition("://")
    if not slashes:
        return Path(text)
    if scheme == "file" and name:
        return Path(name)
    if not name.strip("/"):
        raise ValueError(f"{text}: is incomplete; give {scheme}://NAME")
    return text.rstrip("/")


def open_storage(location: Location) -> Storage:
    """The storage at a location, without any access yet.

    Raises:
        ValueError: a URL of an unsupported kind, or whose package is missing.
    """
    place = as_location(location) if isinstance(location, str) else location
    return RemoteStorage(place) if isinstance(place, str) else LocalStorage(place)


def join(location: Location, name: str) -> Location:
    """A location below another."""
    place = as_location(location) if isinstance(location, str) else location
    return f"{place}/{name}" if isinstance(place, str) else place / name


def absolute(location: Location) -> Location:
    """The same location, valid for a process with another working directory."""
    place = as_location(location) if isinstance(location, str) else location
    return place if isinstance(place, str) else place.resolve()


def map_in_order(function: Callable[[T], R], items: Iterable[T], storage: Storage) -> Iterator[R]:
    """`function` of each item, in order; with remote storage several calls run concurrently.

    Raises:
        Exception: what `function` raises, when its item is due.
    """
    if not storage.is_remote:
        yield from map(function, items)
        return
    waiting: deque[Future[R]] = deque()
    with ThreadPoolExecutor(_CONCURRENT_REQUESTS) as threads:
        try:
            for item in items:
                waiting.append(threads.submit(function, item))
                if len(waiting) >= _CONCURRENT_REQUESTS:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


class LocalStorage:
    """A local folder as `Storage`: everything appears by one rename and is synced to the disk."""

    is_remote = False

    def __init__(self, root: Path) -> None:
        self._root = root

    def where(self, name: str = "") -> str:
        """Path of a file."""
        return str(self._root / name)

    def path(self, name: str) -> Path | None:
        """The file itself."""
        return self._root / name

    def root_exists(self) -> bool:
        """Whether the folder exists."""
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
        path = self._root / name
        if offset == 0 and size is None:
            return read_regular(path)
        with open_regular(path) as stream:
            stream.seek(offset)
            data = stream.read(MOST_BYTES + 1 if size is None else min(size, MOST_BYTES + 1))
        if len(data) > MOST_BYTES:
            raise OSError(errno.EFBIG, f"is to be read by more than {MOST_BYTES} bytes at once", str(path))
        return data

    def read_inside(self, name: str) -> bytes:
        """A file that is no link out of its folder, at the time when it is opened."""
        return read_regular(self._root / name, in_folder=True)

    def open(self, name: str) -> AbstractContextManager[BinaryIO]:
        """The file itself."""
        return open_regular(self._root / name)

    def names(self, folder: str) -> list[str]:
        """Names directly in a folder."""
        try:
            return sorted(entry.name for entry in os.scandir(self._root / folder))
        except (FileNotFoundError, NotADirectoryError):
            return []

    def files_ending(self, suffix: str) -> list[str]:
        """All files with the suffix, at any depth."""
        found = self._root.rglob(f"*{suffix}")
        return sorted(
            path.relative_to(self._root).as_posix() for path in found if path.is_file() and not path.is_symlink()
        )

    def folders_with(self, folder: str, mark: str) -> list[str]:
        """Folders that hold the file `mark`."""
        return [name for name in self.names(folder) if (self._root / folder / name / mark).is_file()]

    def leftovers(self, folder: str, mark: str) -> list[str]:
        """Whatever still has a temporary name; a folder gets its final one only with all its files."""
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
        """A text stream whose file appears by one rename."""
        return open_text_atomic(self._root / name)

    def write_large(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A stream of bytes whose file appears by one rename."""
        return open_bytes_atomic(self._root / name)

    def spool(self, folder: str) -> TextIO:
        """An unnamed file on the disk of the folder, and not in /tmp, which is in memory on many machines."""
        place = self._root / folder
        place.mkdir(parents=True, exist_ok=True)
        return cast(TextIO, tempfile.TemporaryFile("w+", encoding="utf-8", newline="\n", dir=place))

    def write_together(self, folder: str, files: Mapping[str, bytes], mark: str) -> None:
        """Write all files into a temporary folder, then rename it."""
        target = self._root / folder
        part = part_path(target)
        try:
            part.mkdir(parents=True)
            for name in sorted(files):
                _write_synced(part / name, files[name])
            sync_folder(part)
            self._remove_atomically(target)
            part.rename(target)
            sync_folder(target.parent)
        except OSError as error:
            raise OSError(error.errno, f"{target}: cannot be written: {error.strerror}") from error
        finally:
            shutil.rmtree(part, ignore_errors=True)

    def delete(self, name: str) -> None:
        """Remove a file, or a leftover folder of a killed run."""
        path = self._root / name
        try:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:
            raise OSError(error.errno, f"{path}: cannot be removed: {error.strerror}") from error

    def delete_folder(self, folder: str, mark: str) -> None:
        """Rename the folder, then delete it."""
        self._remove_atomically(self._root / folder)

    def _remove_atomically(self, target: Path) -> None:
        if not target.exists():
            return
        renamed = part_path(target)
        target.rename(renamed)
        shutil.rmtree(renamed)


def _write_synced(path: Path, data: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
