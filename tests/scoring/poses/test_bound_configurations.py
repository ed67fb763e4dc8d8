"""Bounds from a subset of the features: one eye, some markers, a noisier hub, a drogue that departs from nominal."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from drogue_models.marker_layout import MarkerLayout
from drogue_models.parameters import even_ring
from droguekit.scoring.poses.cramer_rao import (
    FeatureNoise,
    center_jacobian,
    feature_points,
    features_seen,
    pose_bound,
)
from geometry.circles import project_disc_centers
from geometry.stereo import EYES, Eye

RING_M = 0.28
EIGHT = tuple(range(8))


def layout_of(disc: float = 1.0, scale: float = 1.0) -> MarkerLayout:
    centers = np.zeros((8, 3))
    centers[:, :2] = even_ring(8, RING_M * scale)
    return MarkerLayout(centers, 0.05 * disc, np.array([0.0, 0.0, 0.25]), 0.05 * disc, 0.075 * disc)


@pytest.mark.parametrize(
    ("eyes", "markers", "hub", "hub_noise", "expected"),
    [
        # Distance 10 m, 1 px, facing; X, Z [mm], pitch [deg].
        (EYES, EIGHT, False, 1.0, (1.62, 40.9, 16.4)),
        (EYES, EIGHT, True, 1.0, (1.19, 40.8, 0.836)),
        (EYES, EIGHT, True, 3.0, (1.20, 40.9, 2.36)),
        (EYES, EIGHT[1:], False, 1.0, (1.90, 44.8, 18.1)),
        (("left",), EIGHT, False, 1.0, (2.29, 60.5, 23.7)),
        (("left",), EIGHT, True, 1.0, (1.72, 59.2, 1.18)),
    ],
)
def test_golden_configurations(
    build: SimpleNamespace,
    eyes: tuple[Eye, ...],
    markers: tuple[int, ...],
    hub: bool,
    hub_noise: float,
    expected: tuple[float, float, float],
) -> None:
    layout = layout_of(disc=1e-3)
    seen = features_seen(layout, eyes, markers, hub)
    bound = pose_bound(build.rig, build.pose(0.06, 0, 10), layout, seen, FeatureNoise(1.0, hub_noise))
    # Three digits.
    np.testing.assert_allclose([1e3 * bound[0], 1e3 * bound[2], bound[3]], expected, rtol=0.005)


@pytest.mark.parametrize("eye", EYES)
def test_the_last_column_is_the_slope_along_the_rings_size(build: SimpleNamespace, eye: Eye) -> None:
    pose, step = build.pose(0.2, -0.1, 2.5, 9, -14, 21), 1e-6
    ends = [
        project_disc_centers(build.rig, pose, *feature_points(layout_of(scale=scale)), eye)
        for scale in (1 + step, 1 - step)
    ]
    # Central differences of values of 1e3 px with 1e-16 relative rounding over steps of 1e-6: 1e-7.
    slope = (ends[0] - ends[1]) / (2 * step)
    np.testing.assert_allclose(center_jacobian(build.rig, pose, layout_of(), eye)[..., 6], slope, atol=1e-5)
    assert not slope[8].any()


def test_the_bound_is_proportional_to_the_noise(build: SimpleNamespace) -> None:
    layout, pose = layout_of(), build.pose(0.3, -0.2, 6, 5, -8, 3)
    unit, scaled = (
        pose_bound(build.rig, pose, layout, features_seen(layout), FeatureNoise(s, 2.5 * s)) for s in (1.0, 0.03)
    )
    # Rounding of a 6x6 inverse whose condition is 1e6.
    np.testing.assert_allclose(scaled, 0.03 * unit, rtol=1e-9)


def test_a_useless_hub_is_none(build: SimpleNamespace) -> None:
    layout, pose = layout_of(), build.pose(0.3, -0.2, 6, 5, -8, 3)
    without = pose_bound(build.rig, pose, layout, features_seen(layout, hub=False))
    useless = pose_bound(build.rig, pose, layout, features_seen(layout), FeatureNoise(1.0, 1e6))
    # Its weight is 1e-12.
    np.testing.assert_allclose(useless, without, rtol=1e-6)


def test_the_less_is_known_of_the_ring_the_larger_the_bound(build: SimpleNamespace) -> None:
    layout, pose, noise = layout_of(), build.pose(0.3, -0.2, 12, 5, -8, 3), FeatureNoise(0.02, 0.05)
    bounds = [
        pose_bound(build.rig, pose, layout, features_seen(layout), noise, scale_sd)
        for scale_sd in (None, 1e-7, 1e-3, 3e-3, 1e-2)
    ]
    # A scale known to 1e-7 is known for all that matters.
    np.testing.assert_allclose(bounds[1], bounds[0], rtol=1e-4)
    for closer, looser in pairwise(bounds[1:]):
        assert (looser >= closer * (1 - 1e-9)).all()
        assert looser[2] > 1.01 * closer[2]


def test_the_mask_names_what_is_seen() -> None:
    seen = features_seen(layout_of(), ("right",), (1, 4), hub=True)
    assert np.argwhere(seen).tolist() == [[1, 1], [1, 4], [1, 8]]
    assert features_seen(layout_of()).all()


def test_noise_and_scale_must_be_positive(build: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match=r"noise: must be positive, got 0\.0 and 1\.0 px"):
        FeatureNoise(0.0, 1.0)
    layout = layout_of()
    with pytest.raises(ValueError, match=r"ring_scale_sd: must be positive, or None .*, got 0\.0"):
        pose_bound(build.rig, build.pose(0, 0, 5), layout, features_seen(layout), ring_scale_sd=0.0)
