"""Compilation of loops over numbers for this machine's processor, by numba."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core.caching import FunctionCache
from numba.extending import intrinsic
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

_Loop = TypeVar("_Loop", bound=Callable[..., Any])

# The compiler may take sums in any order and turn divisions into products, so that a processor works on many pixels at
# once. Infinities and NaN keep their meaning: a step that diverges must be seen.
_FASTMATH = {"reassoc", "nsz", "contract", "arcp"}
# A caller's machine code holds all that it calls, inlined. Numba would keep a copy of a large function in each of its
# callers, each with its own order of sums, and the linker would take the first in the process for all: results would
# depend on what else the process had compiled or loaded. Nothing calls the loops from C.
_OPTIONS = {
    "fastmath": _FASTMATH,
    "forceinline": True,
    "no_cfunc_wrapper": True,
    "error_model": "numpy",
    "nogil": True,
}
# In every file that holds compiled functions, this one included.
_MARK = b"@compiled"


def compiled(loop: _Loop) -> _Loop:
    """Compile a function over arrays at its first call, and keep the result on disk for later processes.

    The result is kept beside the function's file, else in the user's cache folder; where neither can be written, every
    process compiles anew.
    """
    quick: Any = numba.njit(loop, **_OPTIONS)
    with suppress(RuntimeError):  # numba found no folder that can be written
        quick._cache = _KernelCache(loop)
    kernel: _Loop = quick
    return kernel


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """Numba's cache on disk, which does not see changes in other files whose compiled functions a function calls."""

    def _index_key(self, signature: Any, code_generator: Any) -> tuple[Any, ...]:
        return (*super()._index_key(signature, code_generator), _sources_digest())


@cache
def _sources_digest() -> str:
    """Hash of all files of this package that hold compiled functions."""
    texts = (path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py")))
    return hashlib.sha256(b"".join(text for text in texts if _MARK in text)).hexdigest()


@intrinsic  # type: ignore[untyped-decorator]
def float_of_bits(typing_context: Any, bits: Any) -> Any:
    """The single-precision number that 32 bits, given as an integer, stand for."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate
