"""Compilation of loops over numbers for this machine's processor, by numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from geometry.compiled_loops import kept_on_disk

Array32 = NDArray[np.float32]

_Loop = TypeVar("_Loop", bound=Callable[..., Any])

# The compiler may take sums in any order and turn divisions into products, so that a processor works on many pixels at
# once. Infinities and NaN keep their meaning: a step that diverges must be seen.
FASTMATH = {"reassoc", "nsz", "contract", "arcp"}
# A caller's machine code holds all that it calls, inlined. Numba would keep a copy of a large function in each of its
# callers, each with its own order of sums, and the linker would take the first in the process for all: results would
# depend on what else the process had compiled or loaded. Nothing calls the loops from C.
_OPTIONS = {
    "fastmath": FASTMATH,
    "forceinline": True,
    "no_cfunc_wrapper": True,
    "error_model": "numpy",
    "nogil": True,
}


def compiled(loop: _Loop) -> _Loop:
    """Compile a function over arrays at its first call, and keep the result on disk; see `kept_on_disk`."""
    return kept_on_disk(loop, _OPTIONS)


@compiled
def is_finite(number: float) -> bool:
    """Whether a number is neither infinite nor NaN.

    numba's `isfinite` subtracts the number from itself, which cancels where sums may be reordered: NaN would pass.
    """
    return abs(number) < np.inf


@intrinsic  # type: ignore[untyped-decorator]
def float_of_bits(typing_context: Any, bits: Any) -> Any:
    """The single-precision number that 32 bits, given as an integer, stand for."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate
