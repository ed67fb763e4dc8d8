from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from drogue_models.marker_layout import MarkerLayout
from drogue_models.parameters import even_ring
from droguekit.scoring.poses.cramer_rao import FacingRing, FeatureNoise, features_seen, flip_probability, pose_bound
from geometry.stereo import paper_rig

RING_M = 0.28
FOCAL_PX, BASELINE_M = paper_rig().camera.fx_px, paper_rig().baseline_m


def ring(count: int = 8, distance_m: float = 10.0) -> FacingRing:
    return FacingRing(FOCAL_PX, BASELINE_M, RING_M, count, distance_m)


def points(count: int = 8, hub_m: float | None = None) -> MarkerLayout:
    """Features so small that the centres of their images are the images of their centres."""
    centers = np.zeros((count, 3))
    centers[:, :2] = even_ring(count, RING_M)
    hub = None if hub_m is None else np.array([0.0, 0.0, hub_m])
    return MarkerLayout(centers, 1e-5, hub, *((0.0, 0.0) if hub is None else (1e-5, 2e-5)))


def facing_bound(build: SimpleNamespace, layout: MarkerLayout, distance_m: float, **options: object) -> np.ndarray:
    pose = build.pose(BASELINE_M / 2, 0, distance_m)
    bound = pose_bound(build.rig, pose, layout, features_seen(layout), **options)
    assert bound is not None
    return bound


@pytest.mark.parametrize("count", [5, 7, 8])
@pytest.mark.parametrize("distance_m", [5.0, 15.0, 40.0])
def test_the_known_ring_agrees_with_the_numeric_bound(build: SimpleNamespace, count: int, distance_m: float) -> None:
    _, _, z, pitch, yaw = facing_bound(build, points(count), distance_m)
    limit = ring(count, distance_m)
    # What is left out is of the order (R / Z)^2.
    left_out = (RING_M / distance_m) ** 2
    assert limit.depth_m == pytest.approx(z, rel=left_out)
    assert limit.tilt_rad == pytest.approx(np.deg2rad(pitch), rel=left_out)
    assert limit.tilt_rad == pytest.approx(np.deg2rad(yaw), rel=left_out)


@pytest.mark.parametrize("noise_factor", [1.0, 2.5])
@pytest.mark.parametrize("distance_m", [5.0, 15.0, 40.0])
def test_the_hub_law_agrees_with_the_numeric_bound(
    build: SimpleNamespace, noise_factor: float, distance_m: float
) -> None:
    noise = FeatureNoise(1.0, noise_factor)
    pitch = facing_bound(build, points(8, 0.25), distance_m, noise=noise)[3]
    law = ring(8, distance_m).hub_tilt_rad(0.25, noise_factor)
    # The law leaves out that the hub is h farther away than the ring, and the ring's own knowledge of tilt: 2 %.
    assert law == pytest.approx(np.deg2rad(pitch), rel=0.25 / distance_m + 0.02)


@pytest.mark.parametrize("sigma_px", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("distance_m", [5.0, 10.0, 30.0])
def test_the_fusion_law_agrees_with_the_numeric_bound(
    build: SimpleNamespace, sigma_px: float, distance_m: float
) -> None:
    scale_sd = 0.5e-3 / RING_M
    noise = FeatureNoise(sigma_px, sigma_px)
    z = facing_bound(build, points(), distance_m, noise=noise, ring_scale_sd=scale_sd)[2]
    # What is left out is of the order (R / Z)^2, in each of the two terms.
    expected = pytest.approx(z, rel=2 * (RING_M / distance_m) ** 2)
    assert ring(8, distance_m).toleranced_depth_m(sigma_px, scale_sd) == expected


@pytest.mark.parametrize("distance_m", [2.0, 10.0])
def test_each_tolerance_weakens_its_own_source_of_depth(distance_m: float) -> None:
    limit, sigma_px = ring(8, distance_m), 0.01
    exact = limit.toleranced_depth_m(sigma_px, 0.0)
    assert exact == pytest.approx(sigma_px * limit.depth_m, rel=1e-12)
    # A source that knows nothing leaves the other one.
    assert limit.toleranced_depth_m(sigma_px, 1e6) == pytest.approx(sigma_px * limit.stereo_depth_m, rel=1e-6)
    size_alone = limit.toleranced_depth_m(sigma_px, 0.0, disparity_sd_px=1e9)
    assert size_alone == pytest.approx(sigma_px * limit.size_depth_m, rel=1e-6)
    # Nothing but placement: the mean of eight radial errors is the radius's.
    placed = limit.toleranced_depth_m(1e-9, 0.0, 1e9, 3e-4)
    assert placed == pytest.approx(limit.toleranced_depth_m(1e-9, 3e-4 / (RING_M * np.sqrt(8)), 1e9), rel=1e-12)


def test_size_and_disparity_make_up_the_known_ring() -> None:
    limit = ring()
    # Rounding: independent sources of information add up.
    assert limit.stereo_depth_m**-2 + limit.size_depth_m**-2 == pytest.approx(limit.depth_m**-2, rel=1e-12)
    assert limit.toleranced_depth_m(0.1, 1e3) == pytest.approx(0.1 * limit.stereo_depth_m, rel=1e-6)
    assert limit.toleranced_depth_m(0.1, 0.0) == pytest.approx(0.1 * limit.depth_m, rel=1e-12)


def test_stereo_without_geometry_is_the_spread_of_triangulated_markers(
    build: SimpleNamespace, rng: np.random.Generator
) -> None:
    sigma, pose, layout = 0.01, build.pose(BASELINE_M / 2, 0, 10), points()
    left, right = (
        build.rig.project(pose.apply(layout.centers_m), eye) + rng.normal(0, sigma, (4000, 8, 2))
        for eye in ("left", "right")
    )
    places = build.rig.triangulate(left, right)
    slopes = np.linalg.pinv(np.column_stack([layout.centers_m[:, :2], np.ones(8)])) @ places[..., 2:]
    # A standard deviation of 4000 samples is known to 1.1 %; four of those.
    assert places[..., 2].mean(axis=1).std() == pytest.approx(sigma * ring().stereo_depth_m, rel=0.045)
    assert slopes[:, 0, 0].std() == pytest.approx(sigma * ring().stereo_tilt_rad, rel=0.045)
    assert slopes[:, 1, 0].std() == pytest.approx(sigma * ring().stereo_tilt_rad, rel=0.045)


def test_golden_numbers() -> None:
    # Ring of 0.28 m, 8 markers, noise 1 px, 10 m; all with the digits given.
    assert ring().stereo_depth_m == pytest.approx(195.3e-3, abs=0.05e-3)
    assert np.rad2deg(ring().stereo_tilt_rad) == pytest.approx(56.5, abs=0.05)
    # The golden 40.9 mm, 16.4 deg and 0.836 deg are of the numeric bound; the last differs by 4 %.
    assert ring().depth_m == pytest.approx(40.9e-3, abs=0.06e-3)
    assert np.rad2deg(ring().tilt_rad) == pytest.approx(16.4, abs=0.06)
    assert np.rad2deg(ring().hub_tilt_rad(0.25)) == pytest.approx(0.836, rel=0.04)
    # Depth error where the radius is known to 0.5 mm, at 0.02 px: 3.8 mm.
    assert ring().toleranced_depth_m(0.02, 0.5 / 280) == pytest.approx(3.8e-3, abs=0.05e-3)


@pytest.mark.parametrize(("distance_m", "expected_deg"), [(10, 1.64), (15, 3.69), (20, 6.56)])
def test_golden_scale_of_the_flip_law(distance_m: float, expected_deg: float) -> None:
    assert 0.1 * np.rad2deg(ring(8, distance_m).tilt_rad) == pytest.approx(expected_deg, abs=0.005)


def test_the_flip_law() -> None:
    # s0 = 6.56 deg: 0.180 for a tilt of 6 deg, to the digits given.
    assert flip_probability(6.0, 0.1 * np.rad2deg(ring(8, 20).tilt_rad)) == pytest.approx(0.180, abs=5e-4)
    assert flip_probability(0.0, 1.0) == 0.5
    assert flip_probability(1.0, 1.0) == pytest.approx(0.158655, abs=1e-6)


@pytest.mark.parametrize("field", ["focal_px", "baseline_m", "ring_radius_m", "distance_m"])
def test_lengths_must_be_positive(field: str) -> None:
    values = {"focal_px": 1.0, "baseline_m": 1.0, "ring_radius_m": 1.0, "count": 8, "distance_m": 1.0, field: 0.0}
    with pytest.raises(ValueError, match=f"{field}: must be positive, got 0.0"):
        FacingRing(**values)


def test_two_markers_are_no_ring() -> None:
    with pytest.raises(ValueError, match="count: must be at least 3, got 2"):
        ring(2)
