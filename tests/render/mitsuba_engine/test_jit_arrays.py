"""Kernels read no memory that is not theirs, and are not compiled anew by where an array happens to lie."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.mitsuba

# Numbers whose last one is followed by a page that nobody may read. What goes wrong is a segmentation fault, hence a
# process of its own.
SCRIPT = """
import ctypes
import mmap
import sys

import mitsuba as mi
import numpy as np

from render.mitsuba_engine.variant import probe_variant

if probe_variant().variant == "scalar_rgb":
    sys.exit(77)
mi.set_variant("llvm_ad_rgb")
from render.mitsuba_engine.jit_arrays import jit_array, jit_tensor

count = int(sys.argv[1])
memory = mmap.mmap(-1, 2 * mmap.PAGESIZE)
start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
libc = ctypes.CDLL(None, use_errno=True)
assert libc.mprotect(ctypes.c_void_p(start + mmap.PAGESIZE), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
for kind, dtype in ((mi.UInt32, np.uint32), (mi.Float, np.float32)):
    values = np.frombuffer(memory, dtype=dtype, count=count, offset=mmap.PAGESIZE - 4 * count)
    values[:] = np.arange(count)
    array = np.array(jit_array(kind, values) * 3 + 1)
    assert array.dtype == dtype and (array == 3 * np.arange(count) + 1).all()
tensor = np.array(jit_tensor(values.reshape(-1, 1)) * 3 + 1)
assert tensor.shape == (count, 1) and (tensor[:, 0] == array).all()
"""


@pytest.mark.parametrize("count", [1, 17, 1000])
def test_kernels_do_not_read_beyond_what_numpy_owns(count: int) -> None:
    command = [sys.executable, "-c", SCRIPT, str(count)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if done.returncode == 77:
        pytest.skip("the scalar variant has no kernels")
    assert done.returncode == 0, done.stderr
