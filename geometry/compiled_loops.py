"""Compilation of loops over numbers by numba, kept on disk until the code that it was made of changes."""

from __future__ import annotations

import hashlib
import io
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

_Loop = TypeVar("_Loop", bound=Callable[..., Any])

# In every file that holds compiled functions, or makes them.
_MARK = b"compiled"


def compiled(loop: _Loop) -> _Loop:
    """Compile a function over arrays at its first call, without reordering of floating-point operations."""
    return kept_on_disk(loop, {"error_model": "numpy", "nogil": True})


def inlined(loop: _Loop) -> _Loop:
    """Compile a function as `compiled` does, into the machine code of each that calls it."""
    return kept_on_disk(loop, {"error_model": "numpy", "nogil": True, "forceinline": True})


def kept_on_disk(loop: _Loop, options: Mapping[str, Any]) -> _Loop:
    """Compile a function at its first call, and keep the result on disk for later processes.

    The result is kept beside the function's file, else in the user's cache folder; where neither can be written, every
    process compiles anew. A damaged one is compiled and written anew.

    Args:
        loop: to compile; what it calls in other files must be of the same package.
        options: of `numba.njit`.
    """
    quick: Any = numba.njit(loop, **options)
    with suppress(RuntimeError):  # numba found no folder that can be written
        quick._cache = _KernelCache(loop)
    kernel: _Loop = quick
    return kernel


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """Numba's cache on disk, which does not see changes in other files whose compiled functions a function calls."""

    def __init__(self, loop: Callable[..., Any]) -> None:
        super().__init__(loop)
        self._package = loop.__module__.partition(".")[0]
        locator = self._impl.locator
        self._cache_file = _CheckedFiles(self._cache_path, self._impl.filename_base, locator.get_source_stamp())

    def save_overload(self, signature: Any, compiled_loop: Any) -> None:
        """Keep a result, unless the disk is full or the folder has gone."""
        with suppress(OSError):
            super().save_overload(signature, compiled_loop)

    def _index_key(self, signature: Any, code_generator: Any) -> tuple[Any, ...]:
        return (*super()._index_key(signature, code_generator), _sources_digest(self._package))


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """Files of the cache that end in a checksum: a flipped bit of machine code ends a process, or changes results."""

    @contextmanager
    def _open_for_write(self, path: str) -> Iterator[io.BytesIO]:
        contents = io.BytesIO()
        yield contents
        with super()._open_for_write(path) as file:
            file.write(contents.getvalue() + hashlib.sha256(contents.getvalue()).digest())

    def _load_index(self) -> dict[Any, str]:
        return super()._load_index() if _is_intact(self._index_path) else {}

    def _load_data(self, name: str) -> Any:
        if not _is_intact(self._data_path(name)):
            raise FileNotFoundError  # which numba takes for a file that was removed
        return super()._load_data(name)


def _is_intact(path: str) -> bool:
    size = hashlib.sha256().digest_size
    try:
        data = Path(path).read_bytes()
    except OSError:
        return False
    return hashlib.sha256(data[:-size]).digest() == data[-size:]


@cache
def _sources_digest(package: str) -> str:
    """Hash of all files of a package that hold compiled functions."""
    folders = [Path(folder) for folder in sys.modules[package].__path__]
    texts = (path.read_bytes() for folder in folders for path in sorted(folder.rglob("*.py")))
    return hashlib.sha256(b"".join(text for text in texts if _MARK in text)).hexdigest()
