"""Numbers in the YAML files that other programs read."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def yaml_number(value: float) -> str:
    """Shortest digits that read back the same.

    YAML 1.1, which ROS and Kalibr read, takes `1e-05` for a word: a number needs its point before the exponent.
    """
    digits = repr(float(value))
    mantissa, sign, exponent = digits.partition("e")
    return digits if not sign or "." in mantissa else f"{mantissa}.0e{exponent}"


def yaml_list(values: ArrayLike) -> str:
    """All numbers of an array, row by row, on one line."""
    return f"[{', '.join(yaml_number(value) for value in np.asarray(values, dtype=np.float64).ravel())}]"
