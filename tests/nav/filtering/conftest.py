"""Measured poses, drawn or given."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from datasets_manifest.types.estimates import PoseEstimate
from geometry.se3 import RigidTransform, exp_rotation

Measure = Callable[..., PoseEstimate]


@pytest.fixture
def rng() -> np.random.Generator:
    """The same draws in every test."""
    return np.random.default_rng(10)


@pytest.fixture
def measure() -> Measure:
    """A measured pose: a true one, moved by an error drawn from its covariance where a generator is given."""

    def measured(
        pose: RigidTransform, covariance: np.ndarray, rng: np.random.Generator | None = None, index: int = 0
    ) -> PoseEstimate:
        error = np.zeros(6) if rng is None else np.linalg.cholesky(covariance) @ rng.standard_normal(6)
        moved = RigidTransform(exp_rotation(error[3:]) @ pose.rotation, pose.translation_m + error[:3])
        return PoseEstimate(frame_index=index, method="drawn", left_from_drogue=moved, covariance=covariance)

    return measured


@pytest.fixture
def covariance() -> np.ndarray:
    """Of a fix at some metres, with a correlation: 2, 2, 10 mm, 3 mrad."""
    correlation = np.eye(6)
    correlation[0, 4] = correlation[4, 0] = 0.5
    correlation[1, 3] = correlation[3, 1] = -0.5
    sd = np.array([0.002, 0.002, 0.01, 0.003, 0.003, 0.003])
    return correlation * np.outer(sd, sd)
