"""Default settings with the motion that recipes make: a docking run in moderate air, with drawn noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.types.estimates import PoseEstimate
from nav.filtering.measurement_update import pose_difference
from nav.filtering.motion_model import FilterSettings
from nav.filtering.pose_filter import PoseFilter
from scenes.sampler import sample_left_from_drogue

Measure = Callable[..., PoseEstimate]
PERIOD_S = 0.04
AHEAD = 10


def test_a_docking_run_in_moderate_air(rng: np.random.Generator, measure: Measure, covariance: np.ndarray) -> None:
    recipe = load_recipe("docking-10m", 1).recipe
    poses = [sample_left_from_drogue(recipe, index) for index in range(450, 750)]
    fine, fixes = covariance * 0.01, PoseFilter(FilterSettings(), 8)
    nis: list[float] = []
    here: list[float] = []
    later: list[float] = []
    for index, pose in enumerate(poses):
        assert pose is not None
        update = fixes.update(index * PERIOD_S, measure(pose, fine, rng))
        assert update.accepted and update.state is not None
        ahead = fixes.predict((index + AHEAD) * PERIOD_S)
        then = poses[index + AHEAD] if index + AHEAD < len(poses) else None
        for squares, state, true in ((here, update.state, pose), (later, ahead, then)):
            if true is None:
                continue
            assert state is not None
            error, spread = pose_difference(state.left_from_drogue, true), state.covariance[:6, :6]
            squares.append(float(error @ np.linalg.solve(spread, error)) / 6)
        if update.nis is not None:
            nis.append(update.nis / 6)
    # Means of 300 chi-squares of six degrees lie within 0.1 of 1 (three deviations). The innovations are not Gaussian,
    # and the motion of 0.4 s has some 30 independent parts.
    assert 0.9 < np.mean(here) < 1.1
    assert 0.8 < np.mean(nis) < 1.25
    assert 0.5 < np.mean(later) < 1.6
