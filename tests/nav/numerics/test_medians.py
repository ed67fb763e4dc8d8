from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nav.numerics.medians import median


@given(arrays(np.float64, st.integers(1, 12), elements=st.floats(-1e6, 1e6)))
def test_median_is_that_of_numpy(values: np.ndarray) -> None:
    assert median(values) == np.median(values)
    assert median(values.astype(np.float32)) == np.median(values.astype(np.float32))


@pytest.mark.parametrize("values", [[], [1.0, math.nan, 2.0]])
def test_median_of_nothing_and_of_nan_is_nan(values: list[float]) -> None:
    assert math.isnan(median(np.array(values)))
