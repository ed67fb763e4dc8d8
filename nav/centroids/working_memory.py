"""Memory that stays with the process between the arrays of one fit and the next."""

from __future__ import annotations

from functools import cache

import numpy as np

_KEPT_BYTES = 16 * 2**20


@cache
def keep_freed_memory() -> None:
    """Let the C library keep freed memory for the next array, from the first call on.

    GNU's hands the end of its heap back to the system after each larger array, and the system maps and clears the same
    pages anew for the next one, which took a fifth to a third of the time of a fit. It keeps up to twice the largest
    block that was ever freed: one that nobody writes to costs nothing. Other libraries are left as they are.
    """
    np.empty(_KEPT_BYTES, np.uint8)
