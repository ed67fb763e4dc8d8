"""NumPy data as Dr.Jit arrays, in memory that kernels may read; and room in Dr.Jit's registry of shapes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

# The widest vector register; kernels read at most one register past the end.
_REGISTER_BYTES = 64
# Eight cached scenes hold up to 40 shapes each, and the features of their drogues again.
_RESERVED_NUMBERS = 1024


def jit_array(kind: Any, values: ArrayLike) -> Any:
    """A Dr.Jit array with a copy of NumPy data.

    With LLVM, Dr.Jit does not copy a NumPy array: kernels read its memory in whole vector registers, and so past its
    end, which is a segmentation fault where the next page is not mapped. Kernels are also compiled again where the
    array does not start at a multiple of a register. The copy avoids both. With CUDA, Dr.Jit sends it to the GPU.

    Args:
        kind: Dr.Jit type with elements of 4 bytes.
        values: (N,) numbers.
    """
    dtype = np.float32 if dr.is_float_v(kind) else np.uint32
    return kind(_aligned_copy(np.asarray(values), np.dtype(dtype)))


def jit_tensor(values: ArrayLike) -> mi.TensorXf:
    """A Dr.Jit tensor of the shape of `values`; see `jit_array`."""
    array = np.asarray(values)
    return mi.TensorXf(_aligned_copy(array.ravel(), np.dtype(np.float32)).reshape(array.shape))


def _aligned_copy(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """(N,) copy that starts at a multiple of a register and is followed by the bytes of at least one register."""
    used = len(values) * dtype.itemsize
    memory = np.zeros(used + 2 * _REGISTER_BYTES, dtype=np.uint8)
    first = -memory.ctypes.data % _REGISTER_BYTES
    copied: NDArray[Any] = memory[first : first + used].view(dtype)
    copied[:] = values
    return copied


def reserve_registry() -> Any:
    """Raise the highest registry number of shapes, materials and lamps, before the first scene is built.

    Kernels are compiled with the number of registry entries, as the distance between their tables. Free numbers are
    used again, and the count falls only when the highest one is free. So kernels stay valid while scenes with other
    drogues and other objects of the same kinds of material come and go; otherwise each new scene would compile all of
    them again.

    Returns:
        The shape with the highest number; keep it for as long as there are scenes.
    """
    lamp = {
        "type": "rectangle",
        "bsdf": {"type": "diffuse"},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    # All of them must exist at the same time.
    return [mi.load_dict(lamp) for _ in range(_RESERVED_NUMBERS)][-1]
