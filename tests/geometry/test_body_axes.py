from __future__ import annotations

import numpy as np

from geometry.se3 import FLU_FROM_FRD, FRD_FROM_OPTICAL


def test_directions_keep_their_meaning() -> None:
    right, down, forward = np.eye(3)
    np.testing.assert_array_equal(FRD_FROM_OPTICAL.apply([forward, right, down]), np.eye(3))
    forward, right, down = np.eye(3)
    np.testing.assert_array_equal(FLU_FROM_FRD.apply([forward, right, down]), [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
