"""Reads files that may come from anybody: regular ones only, up to a size, with JSON and TOML up to a depth.

A pipe would wait for ever, a device such as /dev/zero has no end, a megabyte of brackets overflows the stack of a
parser that calls itself, and a megabyte of zeros holds gigabytes once it is expanded.
"""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import stat
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np

MOST_BYTES = 2**30
"""Most bytes of a file that is read as a whole."""
MOST_TEXT_BYTES = 2**20
"""Most bytes of a file that people write: a recipe, a drogue, settings, a calibration."""
MOST_NESTING = 100
"""Deepest nesting of JSON and TOML; the deepest file of our own has 12 levels."""
MOST_DIGITS = 300
"""Most digits of a whole number in JSON and TOML: larger ones are no float."""

MOST_MEMORY_BYTES, MEMORY_BYTES_PER_BYTE = 2**30, 64
"""Most memory that a library may take to read a file: the first number, and so much more for each byte of the file."""

_BLOCK_BYTES = 2**20
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
# What does not matter for the nesting of TOML: texts and comments. A text that does not end reaches to the end.
_TOML_TEXTS = re.compile(
    r'"""(?:[^\\"]|\\.|"(?!""))*+(?:"{3,5}|\Z)'
    r"|'''(?:[^']|'(?!''))*+(?:'{3,5}|\Z)"
    r'|"(?:[^"\\\n]|\\.)*+(?:"|$)'
    r"|'[^'\n]*+(?:'|$)"
    r"|#[^\n]*+",
    re.DOTALL | re.MULTILINE,
)
_LONG_KEY = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{MOST_NESTING}}}")
# To look for one digit repeated is a hundred times faster than to look for any of them repeated.
_DIGITS_ALIKE = bytes.maketrans(b"123456789_", b"0000000000")
_LONG_NUMBER = b"0" * (MOST_DIGITS + 1)


def open_regular(path: Path, in_folder: bool = False) -> BinaryIO:
    """Open a regular file, or a link to one, for reading.

    Args:
        path: of the file.
        in_folder: whether a link must lead to a file of the same folder.

    Raises:
        OSError: it is missing, a folder, a pipe, a socket or a device, or leads out of its folder; has the file's name.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer. What was opened is looked at, not what the name means now.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        mode = os.fstat(descriptor).st_mode
        if in_folder and Path(f"/proc/self/fd/{descriptor}").readlink().parent != path.parent.resolve():
            raise OSError(errno.ELOOP, "leads outside its folder", str(path))
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "is a pipe, socket or device, not a regular file", str(path))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: Path, most_bytes: int = MOST_BYTES, in_folder: bool = False) -> bytes:
    """The contents of a regular file of at most so many bytes.

    Raises:
        OSError: as of `open_regular`, or it has more bytes.
    """
    with open_regular(path, in_folder) as stream:
        size = os.fstat(stream.fileno()).st_size
        # A file may grow while it is read.
        data = b"" if size > most_bytes else stream.read(most_bytes + 1)
    if size > most_bytes or len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"has more than {most_bytes} bytes, which are too many for such a file", str(path))
    return data


def read_text(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """The contents of a regular file of UTF-8 text, with or without a byte order mark.

    Raises:
        OSError: as of `read_regular`.
        UnicodeDecodeError: it is not UTF-8.
    """
    return read_regular(path, most_bytes).decode("utf-8-sig")


def parse_json(data: bytes | str, with_nan: bool = False) -> Any:
    """The value in a JSON text.

    Args:
        data: the text.
        with_nan: whether to read NaN and Infinity, which are not JSON, but which other programs write.

    Raises:
        ValueError: not JSON, nested deeper than `MOST_NESTING`, a number that is not finite, or one of too many digits.
    """
    encoded = data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data
    if _json_depth(encoded) > MOST_NESTING:
        raise ValueError(f"is nested more than {MOST_NESTING} levels deep")
    try:
        text = data if isinstance(data, str) else data.decode(json.detect_encoding(data))
        parse_int = _whole_number if _has_long_number(text) else None
        return json.loads(text, parse_constant=None if with_nan else _refuse_constant, parse_int=parse_int)
    except RecursionError as error:
        raise ValueError("is nested too deep") from error


def parse_toml(text: str) -> dict[str, Any]:
    """The table in a TOML text.

    Raises:
        ValueError: not TOML, too large, nested or with keys of more parts than `MOST_NESTING`, or a number of too many
            digits.
    """
    if len(text) > MOST_TEXT_BYTES:
        raise ValueError(f"not valid TOML: has more than {MOST_TEXT_BYTES} characters")
    plain = _TOML_TEXTS.sub("a", text)
    depth, deepest = 0, 0
    for bracket in re.findall(r"[\[{\]}]", plain):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    if deepest > MOST_NESTING or _LONG_KEY.search(plain):
        raise ValueError(f"not valid TOML: is nested more than {MOST_NESTING} levels deep")
    if _has_long_number(plain):
        raise ValueError(f"not valid TOML: has a number of more than {MOST_DIGITS} digits")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not valid TOML: {error}") from error


def _json_depth(data: bytes) -> int:
    """The deepest nesting of brackets outside of texts."""
    if b"\\" in data:
        data = re.sub(rb"\\.", b"", data, flags=re.DOTALL)
    in_text, depth, deepest = 0, 0, 0
    for start in range(0, len(data), _BLOCK_BYTES):
        block = np.frombuffer(data, np.uint8, min(_BLOCK_BYTES, len(data) - start), start)
        quotes = np.cumsum(block == ord('"'), dtype=np.int32) + in_text
        low = block | 0x20  # makes [ and {, and ] and }, the same
        steps = (low == ord("{")).astype(np.int32) - (low == ord("}"))
        depths = np.cumsum(np.where(quotes & 1, 0, steps), dtype=np.int64) + depth
        in_text, depth, deepest = int(quotes[-1]) & 1, int(depths[-1]), max(deepest, int(depths.max()))
    return deepest


def _has_long_number(text: str) -> bool:
    """Whether there are more than `MOST_DIGITS` digits or underscores in a row, within texts or not."""
    return _LONG_NUMBER in text.encode("utf-8", "surrogatepass").translate(_DIGITS_ALIKE)


def _whole_number(text: str) -> int:
    if len(text) > MOST_DIGITS:
        raise ValueError(f"has a number of {len(text)} digits, at most {MOST_DIGITS} are read")
    return int(text)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"holds {name}, which is no number of JSON")


class _MemoryLimit:
    """The limit of this process while blocks of `limited_memory` run, in any of its threads."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.blocks = 0
        self.before = self.now = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)


_LIMIT = _MemoryLimit()


@contextmanager
def limited_memory(file_bytes: int) -> Iterator[None]:
    """Let the process take a bounded amount of memory more than it holds, for a library that trusts a file's numbers.

    The limit is that of the whole process: what other threads take meanwhile counts too, so it is a wide one.

    Args:
        file_bytes: size of the file; see `MOST_MEMORY_BYTES`.

    Raises:
        ValueError: the library asked for more, and said so by a `MemoryError`; most raise an error of their own.
    """
    more = MOST_MEMORY_BYTES + MEMORY_BYTES_PER_BYTE * file_bytes
    with _LIMIT.lock:
        if _LIMIT.blocks == 0:
            _LIMIT.before = _LIMIT.now = resource.getrlimit(resource.RLIMIT_DATA)
        _LIMIT.blocks += 1
        _raise_limit(_data_bytes() + more, is_first=_LIMIT.blocks == 1)
    try:
        yield
    except MemoryError as error:
        raise ValueError(f"takes more than {more} bytes of memory, too much for a file of {file_bytes}") from error
    finally:
        with _LIMIT.lock:
            _LIMIT.blocks -= 1
            if _LIMIT.blocks == 0:
                resource.setrlimit(resource.RLIMIT_DATA, _LIMIT.before)


def _raise_limit(most_bytes: int, is_first: bool) -> None:
    """Set the limit of a first block; a further one may only raise it, and none beyond what holds outside."""
    soft, hard = _LIMIT.now
    if not is_first:
        most_bytes = max(most_bytes, soft)
    outside = _LIMIT.before[0]
    if outside == resource.RLIM_INFINITY or most_bytes < outside:
        _LIMIT.now = (most_bytes, hard)
        resource.setrlimit(resource.RLIMIT_DATA, _LIMIT.now)


def _data_bytes() -> int:
    """Memory of this process that counts for the limit."""
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5]) * _PAGE_BYTES
