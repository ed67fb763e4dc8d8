"""NumPy data as Dr.Jit arrays, in memory that kernels may read; and room in Dr.Jit's registry of shapes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

# No vector register is wider, and no kernel reads further past the end than one of them.
_REGISTER_BYTES = 64


def jit_array(kind: Any, values: ArrayLike) -> Any:
    """A Dr.Jit array of numbers.

    Dr.Jit copies nothing of a NumPy array: kernels read where it lies, in whole vector registers and so past its end,
    which is a segmentation fault where the next page of memory belongs to nobody. Where it does not start at a multiple
    of a register, they are also compiled anew. So the numbers are copied to where neither happens.

    Args:
        kind: its type, of 4 bytes a number.
        values: (N,) numbers.
    """
    dtype = np.float32 if dr.is_float_v(kind) else np.uint32
    return kind(_with_room(np.asarray(values), np.dtype(dtype)))


def jit_tensor(values: ArrayLike) -> mi.TensorXf:
    """A Dr.Jit tensor of the shape of `values`; see `jit_array`."""
    array = np.asarray(values)
    return mi.TensorXf(_with_room(array.ravel(), np.dtype(np.float32)).reshape(array.shape))


def _with_room(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """(N,) the same numbers, from a multiple of a register on and followed by at least one register's bytes."""
    used = len(values) * dtype.itemsize
    memory = np.zeros(used + 2 * _REGISTER_BYTES, dtype=np.uint8)
    first = -memory.ctypes.data % _REGISTER_BYTES
    copied: NDArray[Any] = memory[first : first + used].view(dtype)
    copied[:] = values
    return copied


# Eight kept scenes hold up to 40 shapes each, and the features of their drogues once more.
_NUMBERS = 1024


def reserve_numbers() -> Any:
    """Raise the highest number that was ever given to a shape, a paint or a lamp, before the first scene.

    Calls into scenes compile how many numbers there are into their kernels, as the distance between tables. Free
    numbers are given again, and the count falls only when the highest one is free. So kernels stay as they are while
    scenes with other drogues and bystanders of the same kinds of paint come and go; else each new scene would compile
    all of them anew.

    Returns:
        The shape with the highest number, to be kept for as long as there are scenes.
    """
    lamp = {
        "type": "rectangle",
        "bsdf": {"type": "diffuse"},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    # All of them have to be there at once.
    return [mi.load_dict(lamp) for _ in range(_NUMBERS)][-1]
