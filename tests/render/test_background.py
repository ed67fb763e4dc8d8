from __future__ import annotations

import numpy as np

from render.background import background
from scenes.sampler import sample_frame
from scenes.surroundings import surroundings


def exact_rays(frame):
    camera = frame.rig.camera
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = frame.world_from_left.rotate(camera.rays(np.stack([u, v], axis=-1)))
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def test_background_is_the_surroundings_by_pixel(make_recipe):
    """The coarse grid of the clear sky against the sky evaluated at every pixel."""
    frame = sample_frame(make_recipe(scale=0.5), 0)
    image = background(frame)
    around = surroundings(frame.environment)
    expected = around.radiance(exact_rays(frame))
    # Linear interpolation over 8 px (0.4 degrees) of a sky that bends over tens of degrees, and float32.
    assert np.abs(image / expected - 1).max() < 0.01
    assert np.abs(image / expected - 1).mean() < 0.001


def test_turning_camera_blurs_the_sky(make_recipe):
    frame = sample_frame(make_recipe(scale=0.25), 0)
    frame = frame.model_copy(
        update={
            "left_twist_per_s": np.array([0, 0, 0, 0, 1.0, 0]),
            "exposure": frame.exposure.model_copy(update={"time_s": 0.02}),
        }
    )
    sharp = background(frame.model_copy(update={"left_twist_per_s": np.zeros(6)}))
    blurred = background(frame)
    assert not np.array_equal(sharp, blurred)
    # Blur moves light about and keeps its sum, but for what crosses the edges (10 px of 320).
    assert abs(blurred.mean() / sharp.mean() - 1) < 0.02


def test_the_sun_is_drawn_where_it_stands(make_recipe):
    frame = sample_frame(make_recipe(scale=1.0), 0)
    environment = frame.environment.model_copy(
        update={"sun_elevation_deg": 6.0, "sun_azimuth_deg": 4.0, "visibility_m": 4e5, "cloud": None}
    )
    image = background(frame.model_copy(update={"environment": environment})).max(axis=-1)
    disc = image > 1e7
    sun = surroundings(environment).sky.sun_direction
    in_camera = frame.world_from_left.inverse().rotate(sun)
    expected = frame.rig.camera.project(in_camera)
    v, u = np.nonzero(disc)
    np.testing.assert_allclose([u.mean(), v.mean()], expected, atol=0.5)
    # 0.533 degrees of 37.2 px each, give or take a pixel's lattice.
    assert abs(np.sqrt(4 * disc.sum() / np.pi) - 0.5332 * np.pi / 180 * 2133.33) < 1.0
