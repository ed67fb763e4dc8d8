"""Compilation of loops over numbers by numba, kept on disk until the code that it was made of changes."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache

_Loop = TypeVar("_Loop", bound=Callable[..., Any])

# In every file that holds compiled functions, or makes them.
_MARK = b"compiled"


def compiled(loop: _Loop) -> _Loop:
    """Compile a function over arrays at its first call, without reordering of floating-point operations."""
    return kept_on_disk(loop, {"error_model": "numpy", "nogil": True})


def kept_on_disk(loop: _Loop, options: Mapping[str, Any]) -> _Loop:
    """Compile a function at its first call, and keep the result on disk for later processes.

    The result is kept beside the function's file, else in the user's cache folder; where neither can be written, every
    process compiles anew.

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

    def _index_key(self, signature: Any, code_generator: Any) -> tuple[Any, ...]:
        return (*super()._index_key(signature, code_generator), _sources_digest(self._package))


@cache
def _sources_digest(package: str) -> str:
    """Hash of all files of a package that hold compiled functions."""
    folders = [Path(folder) for folder in sys.modules[package].__path__]
    texts = (path.read_bytes() for folder in folders for path in sorted(folder.rglob("*.py")))
    return hashlib.sha256(b"".join(text for text in texts if _MARK in text)).hexdigest()
