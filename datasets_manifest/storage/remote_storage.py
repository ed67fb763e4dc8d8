"""Storage at any URL that fsspec supports: objects appear whole, and a folder counts once its last object exists."""

from __future__ import annotations

import errno
import io
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, TextIO, cast

# Tar archives are streamed from end to end: large blocks, so that transfer dominates the latency of the requests.
_BLOCK_BYTES = 2**23


class RemoteStorage:
    """Objects below a URL; see `datasets_manifest.storage.storage.Storage`. It can be pickled, and forked."""

    is_remote = True

    def __init__(self, url: str) -> None:
        """Connect to a URL that fsspec supports.

        Raises:
            ValueError: fsspec does not support it, or lacks a package for it.
        """
        self._url = url
        self._connect()

    def where(self, name: str = "") -> str:
        """The URL."""
        return f"{self._url}/{name}" if name else self._url

    def path(self, name: str) -> Path | None:
        """None, as there is no local file."""
        return None

    def root_exists(self) -> bool:
        """Whether any object exists below the URL."""
        return self._info("") is not None

    def exists(self, name: str) -> bool:
        """Whether there is an object of that name."""
        info = self._info(name)
        return info is not None and info["type"] == "file"

    def leads_outside(self, name: str) -> bool:
        """False, as there are no links."""
        return False

    def size(self, name: str) -> int:
        """Size of an object. [bytes]"""
        with self._named_errors(name, "read"):
            return int(self._fs.info(self._path(name))["size"])

    def read(self, name: str, offset: int = 0, size: int | None = None) -> bytes:
        """An object or a part of it."""
        part = {} if offset == 0 and size is None else {"start": offset, "end": None if size is None else offset + size}
        with self._named_errors(name, "read"):
            return bytes(self._fs.cat_file(self._path(name), **part))

    def read_inside(self, name: str) -> bytes:
        """The object, as there are no links."""
        return self.read(name)

    def open(self, name: str) -> AbstractContextManager[BinaryIO]:
        """A stream that fetches large blocks as they are read."""
        return io.BufferedReader(_ObjectStream(self, name), _BLOCK_BYTES)

    def names(self, folder: str) -> list[str]:
        """Names directly in a folder."""
        with self._named_errors(folder, "read"):
            try:
                entries = self._fs.ls(self._path(folder), detail=False)
            except FileNotFoundError:
                return []
        # Some stores list an empty object for the folder itself.
        own = self._path(folder).strip("/")
        below = (
            entry.removeprefix(f"{self._path(folder)}/").rstrip("/") for entry in entries if entry.strip("/") != own
        )
        return sorted({name for name in below if _is_plain_key(name)})

    def files_ending(self, suffix: str) -> list[str]:
        """All objects with the suffix, at any depth."""
        return [name for name in self._find("") if name.endswith(suffix)]

    def folders_with(self, folder: str, mark: str) -> list[str]:
        """Folders that hold the object `mark`."""
        depth = len(PurePosixPath(folder).parts)
        parts = (PurePosixPath(name).parts for name in self._find(folder))
        return sorted({names[depth] for names in parts if len(names) == depth + 2 and names[-1] == mark})

    def leftovers(self, folder: str, mark: str) -> list[str]:
        """Objects in those folders of a folder that lack the object `mark`, which is written last."""
        depth = len(PurePosixPath(folder).parts)
        deep = [name for name in self._find(folder) if len(PurePosixPath(name).parts) == depth + 2]
        whole = {str(PurePosixPath(name).parent) for name in deep if PurePosixPath(name).name == mark}
        return [name for name in deep if str(PurePosixPath(name).parent) not in whole]

    def write(self, name: str, data: bytes) -> None:
        """Write one object."""
        with self._named_errors(name, "written"):
            self._fs.pipe_file(self._path(name), data)

    @contextmanager
    def write_text(self, name: str) -> Iterator[TextIO]:
        """A text stream into a temporary file, which is uploaded once it is complete."""
        with self.write_large(name) as stream:
            text = io.TextIOWrapper(stream, encoding="utf-8", newline="\n")
            yield text
            text.detach()

    @contextmanager
    def write_large(self, name: str) -> Iterator[BinaryIO]:
        """A stream into a temporary file, uploaded once complete; unnamed, so that a killed process leaves nothing."""
        with tempfile.TemporaryFile() as stream:
            yield cast(BinaryIO, stream)
            stream.flush()
            with self._named_errors(name, "written"):
                self._fs.put_file(f"/proc/self/fd/{stream.fileno()}", self._path(name))

    def spool(self, folder: str) -> TextIO:
        """An unnamed temporary file."""
        return cast(TextIO, tempfile.TemporaryFile("w+", encoding="utf-8", newline="\n"))

    def write_together(self, folder: str, files: Mapping[str, bytes], mark: str) -> None:
        """Delete the old mark, write the other objects, then the new mark."""
        self.delete(f"{folder}/{mark}")
        with self._named_errors(folder, "written"):
            self._fs.pipe({self._path(f"{folder}/{name}"): data for name, data in files.items() if name != mark})
            self._fs.pipe_file(self._path(f"{folder}/{mark}"), files[mark])

    def delete(self, name: str) -> None:
        """Remove an object, if it exists."""
        with self._named_errors(name, "removed"):
            try:
                self._fs.rm_file(self._path(name))
            except FileNotFoundError as error:
                if not self._is_of_object(error, name):
                    raise

    def delete_folder(self, folder: str, mark: str) -> None:
        """Remove the mark first, then all objects."""
        self.delete(f"{folder}/{mark}")
        # One by one: the call that removes many expands brackets in names as patterns.
        for name in self._find(folder):
            self.delete(name)

    def __getstate__(self) -> str:
        return self._url

    def __setstate__(self, state: str) -> None:
        self._url = state
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        self._system, self._root = _connect(self._url, self._process)

    @property
    def _fs(self) -> Any:
        # A connection does not survive a fork, by which data loaders start their processes.
        if self._process != os.getpid():
            self._connect()
        return self._system

    def _path(self, name: str) -> str:
        return f"{self._root}/{name}".rstrip("/")

    def _info(self, name: str) -> dict[str, Any] | None:
        """The store's information on an object or a folder, or None where there is neither.

        Raises:
            OSError: the store does not answer. This must not count as missing, as callers delete what has no entry.
        """
        with self._named_errors(name, "read"):
            try:
                info: dict[str, Any] = self._fs.info(self._path(name))
            except FileNotFoundError:
                return None
        return info

    def _find(self, folder: str) -> list[str]:
        """Names of all objects below a folder, sorted."""
        with self._named_errors(folder, "read"):
            try:
                found = self._fs.find(self._path(folder))
            except FileNotFoundError:
                return []
        prefix = f"{self._root}/"
        names = (path.removeprefix(prefix) for path in found if path.startswith(prefix))
        return sorted(filter(_is_plain_key, names))

    def _is_of_object(self, error: FileNotFoundError, name: str) -> bool:
        """Whether the error says that the object is missing, which may be expected, and not its bucket."""
        return self._path(name) in str(error)

    @contextmanager
    def _named_errors(self, name: str, what: str) -> Iterator[None]:
        """Turn the errors of the libraries behind fsspec into one line that names the object."""
        try:
            yield
        except Exception as error:
            if isinstance(error, FileNotFoundError) and what == "read" and self._is_of_object(error, name):
                raise FileNotFoundError(errno.ENOENT, f"{self.where(name)}: is missing") from error
            reason = " ".join(str(error).split()) or type(error).__name__
            number = getattr(error, "errno", None) or errno.EIO
            if isinstance(error, FileNotFoundError):
                number = errno.EIO
            raise OSError(number, f"{self.where(name)}: cannot be {what}: {reason}") from error


def _is_plain_key(name: str) -> bool:
    """Whether a request for an object reaches that object; others in a store are never ours, and left alone.

    A store may hold keys with `..`, which clients of HTTP join: to delete `frames/x/../../manifest.json` would delete
    the manifest.
    """
    return name.isprintable() and not any(part in ("", ".", "..") for part in name.split("/"))


class _ObjectStream(io.RawIOBase):
    """An object as a file; every read is a request."""

    def __init__(self, storage: RemoteStorage, name: str) -> None:
        """Ask for its size.

        Raises:
            FileNotFoundError: it is missing.
        """
        self._storage, self._name = storage, name
        self._size, self._position = storage.size(name), 0

    def readable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position of the next read."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self._size}[whence]
        self._position = max(0, start + offset)
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer, up to the object's end."""
        size = min(len(buffer), self._size - self._position)
        if size <= 0:
            return 0
        data = self._storage.read(self._name, self._position, size)
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)


@cache
def _connect(url: str, process: int) -> tuple[Any, str]:
    """The file system of a URL, and the URL's path in it; one for each process.

    Raises:
        ValueError: fsspec does not support it, or lacks a package for it.
    """
    try:
        from fsspec.core import url_to_fs  # type: ignore[import-untyped]

        # Cached listings would hide what other processes write.
        system, root = url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        raise ValueError(f'{url}: {error.name or error} is missing: pip install "droguekit[remote]"') from error
    except Exception as error:  # each of fsspec's systems fails in its own way
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{url}: cannot be used as storage: {reason}") from error
    return system, str(root).rstrip("/")
