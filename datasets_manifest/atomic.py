"""Files and folders that appear whole or not at all, temporary folders, and locks between processes."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, BinaryIO, TextIO, cast

MEMORY_FOLDER = Path("/dev/shm")
"""A folder that lies in memory, where there is one."""

PART_SUFFIX = ".part"
"""Suffix of everything that is still being written; such names also begin with a dot."""


_UNWRITABLE = ": cannot be written: "
_OPEN_FILES = re.compile(r"/proc/(\d+)/fd")
# As many links behind each other as Linux follows.
_MOST_LINKS = 40


def is_stream(path: Path) -> bool:
    """Whether a path is a device, a pipe or an open file such as `/dev/stdout`: it is written to, and not replaced."""
    return _open_file(path) is not None or (path.exists() and not path.is_file() and not path.is_dir())


def _open_file(path: Path) -> tuple[int, int] | None:
    """Process and number of an open file that a path names, perhaps by links; None for other paths."""
    for _ in range(_MOST_LINKS):
        found = _OPEN_FILES.fullmatch(os.path.realpath(path.parent))
        if found is not None and path.name.isdecimal():
            return int(found[1]), int(path.name)
        if not path.is_symlink():
            return None
        path = path.parent / path.readlink()
    return None


def _write_to_stream(path: Path, part: Path) -> None:
    """Copy a file into what `is_stream` knows."""
    own = _open_file(path)
    # An open file of this process is not opened once more: it would be written from its beginning.
    target = os.dup(own[1]) if own is not None and own[0] == os.getpid() else os.open(path, os.O_WRONLY)
    with part.open("rb") as source, os.fdopen(target, "wb") as stream:
        shutil.copyfileobj(source, stream)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk, so that they survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def part_path(target: Path) -> Path:
    """A unique path beside `target`, for what is still being written."""
    return target.with_name(f".{target.name}-{uuid.uuid4().hex}{PART_SUFFIX}")


@contextmanager
def open_text_atomic(path: Path) -> Iterator[TextIO]:
    """A UTF-8 text stream whose file takes its name when the block ends without an error.

    Raises:
        OSError: it cannot be written; one line that names the file. Nothing is left behind.
    """
    with _renamed_on_success(path) as part, part.open("x", encoding="utf-8", newline="\n") as stream:
        yield stream
        _sync(stream)


@contextmanager
def open_bytes_atomic(path: Path) -> Iterator[BinaryIO]:
    """A readable stream of bytes whose file takes its name when the block ends without an error.

    Raises:
        OSError: it cannot be written; one line that names the file. Nothing is left behind.
    """
    with _renamed_on_success(path) as part, part.open("x+b") as stream:
        yield cast(BinaryIO, stream)
        _sync(stream)


@contextmanager
def _renamed_on_success(path: Path, is_synced: bool = True) -> Iterator[Path]:
    """A temporary path, which is renamed to `path`, or copied into a stream, when the block ends without an error."""
    part = part_path(path)
    try:
        if is_stream(path):
            with scratch_folder() as folder:
                yield folder / part.name
                _write_to_stream(path, folder / part.name)
            return
        with _parents_made(path):
            try:
                yield part
                with suppress(OSError):  # there is no such file yet, or its file system has no rights
                    shutil.copymode(path, part)
                part.replace(path)
            finally:
                with suppress(OSError):
                    part.unlink(missing_ok=True)
            if is_synced:
                sync_folder(path.parent)
    except OSError as error:
        raise _unwritable(path, error) from error


@contextmanager
def _parents_made(path: Path) -> Iterator[None]:
    """The folder of a path, with what is missing above it; a failure of the block removes what is new and empty."""
    made = [folder for folder in path.parents if not folder.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for folder in made:
                folder.rmdir()
        raise


def _unwritable(path: Path, error: OSError) -> OSError:
    """The error that a path cannot be written; that of a path below it is told by its reason alone."""
    while isinstance(error.__cause__, OSError) and _UNWRITABLE in str(error):
        error = error.__cause__
    return OSError(error.errno, f"{path}{_UNWRITABLE}{error.strerror or error}")


def _sync(stream: IO[Any]) -> None:
    stream.flush()
    os.fsync(stream.fileno())


def write_text_atomic(path: Path, text: str) -> None:
    """Write or replace a text file by one rename.

    Raises:
        OSError: it cannot be written; one line that names the file. Nothing is left behind.
    """
    with open_text_atomic(path) as stream:
        stream.write(text)


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write or replace a file by one rename.

    Raises:
        OSError: it cannot be written; one line that names the file. Nothing is left behind.
    """
    with open_bytes_atomic(path) as stream:
        stream.write(data)


def write_bytes_unsynced(path: Path, data: bytes) -> None:
    """Write or replace a file by one rename, without waiting for the disk: for what is easily made anew.

    A killed process leaves the file whole or not at all, but after a power failure it may be damaged.

    Raises:
        OSError: it cannot be written; one line that names the file. Nothing is left behind.
    """
    with _renamed_on_success(path, is_synced=False) as part:
        part.write_bytes(data)


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to write into, which takes a name when the block ends without an error.

    A folder that exists stays, with its rights, as a mounted one must; it gets the contents at the end.

    Args:
        out: must not exist yet, or be empty.

    Raises:
        ValueError: it exists and is not empty.
        OSError: it cannot be written; one line that names it. Nothing is left behind.
    """
    target = out.resolve()
    is_there = target.exists()
    if is_there and (not target.is_dir() or any(target.iterdir())):
        raise ValueError(f"{out}: is not empty; name a new folder, or delete this one")
    part = part_path(target / "new" if is_there else target)
    try:
        with _parents_made(part):
            part.mkdir()
            try:
                yield part
                if is_there:
                    _move_contents(part, target)
                else:
                    part.rename(target)
                sync_folder(target.parent)
            finally:
                shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise _unwritable(out, error) from error


def _move_contents(source: Path, target: Path) -> None:
    """Move all that is in a folder into another one, or nothing; files last, as they tell that all is there."""
    moved: list[Path] = []
    children = sorted(source.iterdir(), key=lambda child: (child.is_file(), child.name))
    for child in children:
        if (target / child.name).exists():
            raise FileExistsError(errno.EEXIST, f"another process wrote {child.name} into it")
    try:
        for child in children:
            moved.append(child.rename(target / child.name))
    except BaseException:
        for path in moved:
            path.rename(source / path.name)
        raise
    sync_folder(target)


def make_scratch_folder(folder: Path | None = None) -> Path:
    """A new temporary folder of this process; whoever kills the process removes it with `remove_scratch_folders`.

    Args:
        folder: to make it in; None for the system's, which TMPDIR names.

    Raises:
        OSError: it cannot be made.
    """
    return Path(tempfile.mkdtemp(prefix=_scratch_prefix(os.getpid()), dir=folder))


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A temporary folder for the duration of the block.

    Raises:
        OSError: it cannot be made.
    """
    folder = make_scratch_folder()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_scratch_folders(process: int) -> None:
    """Remove the temporary folders of a process that was killed."""
    for place in (Path(tempfile.gettempdir()), MEMORY_FOLDER):
        for folder in place.glob(f"{_scratch_prefix(process)}*"):
            shutil.rmtree(folder, ignore_errors=True)


def _scratch_prefix(process: int) -> str:
    return f"droguekit-{process}-"


def try_lock(file: IO[Any]) -> bool:
    """Lock an open file for this process until it is closed, unless another process holds the lock.

    The kernel releases the lock when the process ends, in whatever way.

    Returns:
        Whether this process now holds the lock.

    Raises:
        OSError: the file system does not support locks.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
