"""Compilation of loops over numbers for this machine's processor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

Array32 = NDArray[np.float32]

_Loop = TypeVar("_Loop", bound=Callable[..., Any])

# Sums may be taken in any order and divisions be products, so that a processor takes many pixels at once. Infinities
# and what is no number keep their meaning: a step gone astray must be seen.
_FREEDOMS = {"reassoc", "nsz", "contract", "arcp"}


def compiled(loop: _Loop) -> _Loop:
    """Compile a function over arrays at its first call, once a machine where its cache can be written.

    The cache sees changes of the function's own file alone, not of files whose compiled functions it calls.
    """
    settings: dict[str, Any] = {"fastmath": _FREEDOMS, "error_model": "numpy", "nogil": True}
    try:
        quick: _Loop = numba.njit(loop, cache=True, **settings)
    except RuntimeError:  # neither beside the file nor at home can anything be written
        quick = numba.njit(loop, **settings)
    return quick


@intrinsic  # type: ignore[untyped-decorator]
def float_of_bits(typing_context: Any, bits: Any) -> Any:
    """The single-precision number that 32 bits, given as an integer, stand for."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate
