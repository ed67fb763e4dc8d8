from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer
from datasets_manifest.types.frame import FrameSpec
from geometry.distortion import BrownConrady, Lens
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_twist
from geometry.stereo import EYES, Eye, StereoRig
from render.background import add_stars, air_in_front, background
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import luminance
from scenes.sky.sky_models import EXTINCTION_MAG, star_catalogue
from tests.support.recipe_builder import paper_view_recipe


def exact_rays(frame: FrameSpec) -> np.ndarray:
    camera = frame.rig.camera
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = frame.world_from_left.rotate(camera.rays(np.stack([u, v], axis=-1)))
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def test_background_is_the_surroundings_by_pixel() -> None:
    """The coarse grid of the clear sky against the sky evaluated at every pixel."""
    frame = sample_frame(paper_view_recipe(scale=0.5), 0)
    image = background(frame)
    around = environment_radiance(frame.environment)
    expected = around.radiance(exact_rays(frame))
    # Linear interpolation over 8 px (0.4 degrees) of a sky that bends over tens of degrees, and float32.
    assert np.abs(image / expected - 1).max() < 0.01
    assert np.abs(image / expected - 1).mean() < 0.001


def test_turning_camera_blurs_the_sky() -> None:
    frame = sample_frame(paper_view_recipe(scale=0.25), 0)
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


def test_the_sun_is_drawn_where_it_stands() -> None:
    frame = sample_frame(paper_view_recipe(scale=1.0), 0)
    environment = frame.environment.model_copy(
        update={"sun_elevation_deg": 6.0, "sun_azimuth_deg": 4.0, "visibility_m": 4e5, "clouds": ()}
    )
    image = background(frame.model_copy(update={"environment": environment})).max(axis=-1)
    disc = image > 1e7
    sun = environment_radiance(environment).sky.sun_direction
    in_camera = frame.world_from_left.inverse().rotate(sun)
    expected = frame.rig.camera.project(in_camera)
    v, u = np.nonzero(disc)
    np.testing.assert_allclose([u.mean(), v.mean()], expected, atol=0.5)
    # 0.533 degrees of 37.2 px each, give or take a pixel's lattice.
    assert abs(np.sqrt(4 * disc.sum() / np.pi) - 0.5332 * np.pi / 180 * 2133.33) < 1.0


@pytest.mark.parametrize("eye", EYES)
def test_stars_stand_where_a_lens_shows_them_and_keep_their_light(eye: Eye) -> None:
    camera, rotation = PinholeCamera(640, 480, 300.0, 300.0, 319.5, 239.5), world_from_camera_up()
    lenses = tuple(
        Lens(camera, BrownConrady(k1=-0.06, p1=1e-3), exp_twist([0, 0, 0, 0.01, -0.02, turn]).rotation)
        for turn in (0.0, 0.02)
    )
    rig = StereoRig(camera, 0.12, lenses=lenses)
    lens = rig.lens(eye)
    stars = np.zeros((480, 640, 3), dtype=np.float32)
    add_stars(stars, rig, eye, rotation)
    corners_px = np.stack(np.meshgrid(np.arange(641) - 0.5, np.arange(481) - 0.5), axis=-1)
    corners = lens.rays(corners_px)
    # (H, W) solid angle of the pixels by their corners on the plane at z = 1, and the cube of their cosine.
    across, other = corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:]
    area = np.abs(across[..., 0] * other[..., 1] - across[..., 1] * other[..., 0]) / 2
    middle = lens.rays(np.stack(np.meshgrid(np.arange(640), np.arange(480)), axis=-1))
    light_lux = luminance(stars) * area / np.linalg.norm(middle, axis=-1) ** 3
    directions, lux = star_catalogue()
    in_left = directions @ rotation
    # All of the image's, up to its corners 60 degrees off the axis; the polynomial folds at 67.
    ahead = in_left[:, 2] > 0.4
    air = 10.0 ** (-0.4 * EXTINCTION_MAG * (1.0 / directions[ahead, 2] - 1.0))
    places, lux = lens.project_rays(in_left[ahead]), lux[ahead] * air
    inside = camera.contains(places, 3.0)
    # Each star shares its light among the four pixels around it, whose solid angles differ by less than 1 %.
    found, wanted = np.zeros((2, 480, 640))
    found += light_lux
    for place, one in zip(places, lux, strict=True):
        if camera.contains(place, 1.0):
            (u, v), (right, down) = np.floor(place).astype(int), place - np.floor(place)
            wanted[v : v + 2, u : u + 2] += one * np.outer([1 - down, down], [1 - right, right])
    assert inside.sum() > 500
    np.testing.assert_allclose(found[3:-3, 3:-3], wanted[3:-3, 3:-3], rtol=0.01, atol=1e-12)


def test_stars_beyond_a_fold_are_not_seen() -> None:
    camera, rotation = PinholeCamera(160, 120, 266.0, 266.0, 79.5, 59.5), world_from_camera_up()
    lens = Lens(camera, BrownConrady(k1=-0.8))
    rig = StereoRig(camera, 0.12, lenses=(lens, lens))
    stars = np.zeros((120, 160, 3), dtype=np.float32)
    add_stars(stars, rig, "left", rotation)
    directions, _ = star_catalogue()
    in_left = directions @ rotation
    seen = in_left[in_left[:, 2] > 0.3]
    seen = seen[rig.is_in_field(camera.project(seen), "left")]
    count = camera.contains(lens.project_rays(seen), -1.0).sum()
    # Each lights four pixels at most.
    assert 0 < np.count_nonzero(luminance(stars)) <= 4 * count


def test_stars_shine_with_all_their_light_and_stay_behind_clouds() -> None:
    """Light of the picture with stars less that of the sky alone, over the pixels' solid angles, is theirs in lux."""
    frame = sample_frame(paper_view_recipe(scale=0.5), 0)
    environment = frame.environment.model_copy(update={"sun_elevation_deg": -40.0, "clouds": ()})
    camera, rotation = frame.rig.camera, world_from_camera_up()
    stars = np.zeros((camera.height_px, camera.width_px, 3), dtype=np.float32)
    add_stars(stars, frame.rig, "left", rotation)
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.rays(np.stack([u, v], axis=-1))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    directions, lux = star_catalogue()
    places = camera.project(directions @ rotation)
    inside = ((directions @ rotation)[:, 2] > 0.5) & camera.contains(places)
    # Overhead the air takes at most 2 %; stars on the border lose some; a pixel's solid angle goes with cos^3.
    got = (luminance(stars) * rays[..., 2] ** 3).sum() / (camera.fx_px * camera.fy_px)
    assert inside.sum() > 20
    assert abs(got / lux[inside].sum() - 1) < 0.05
    overcast = CloudLayer(
        kind="stratus",
        height_above_camera_m=500,
        cover_fraction=1.0,
        feature_size_m=2000,
        optical_depth=60,
        texture_seed=2,
    )
    looking_up = frame.model_copy(
        update={
            "environment": environment.model_copy(update={"clouds": (overcast,)}),
            "world_from_left": RigidTransform(rotation, np.zeros(3)),
        }
    )
    covered = luminance(background(looking_up))
    assert covered.max() < 3 * np.median(covered) < luminance(stars).max()


def world_from_camera_up() -> np.ndarray:
    """Camera axes that look at the zenith."""
    return np.eye(3)


def test_a_lens_that_folds_right_beyond_its_image_shows_the_sky_up_to_the_border() -> None:
    camera = PinholeCamera(320, 240, 200.0, 200.0, 159.5, 119.5)
    # It folds 2 px beyond the corners; the sky is interpolated between places up to 5 px beyond.
    lens = Lens(camera, BrownConrady(k1=-0.145))
    frame = sample_frame(paper_view_recipe(scale=0.25), 0)
    mild, strong = (
        background(frame.model_copy(update={"rig": StereoRig(camera, 0.12, lenses=(one, one))}))
        for one in (Lens(camera, BrownConrady(k1=-0.144)), lens)
    )
    assert np.isfinite(strong).all()
    # The sky's own change over a few pixels, and of the lens's by k1.
    np.testing.assert_allclose(luminance(strong)[:4, :4], luminance(mild)[:4, :4], rtol=0.05)


@pytest.mark.parametrize("eye", EYES)
def test_air_in_front_of_a_lens_is_that_along_its_rays(eye: Eye) -> None:
    """Of two wide lenses, one turned, at random pixels."""
    frame = sample_frame(paper_view_recipe(scale=0.25), 0)
    wide, strong = PinholeCamera(320, 240, 250.0, 250.0, 159.5, 119.5), BrownConrady(k1=0.3)
    turned = Lens(wide, strong, exp_twist([0, 0, 0, 0.02, -0.03, 0.05]).rotation)
    rig = StereoRig(wide, 0.12, lenses=(Lens(wide, strong), turned))
    places = np.random.default_rng(4).integers(0, (320, 240), (500, 2))
    got = air_in_front(frame.model_copy(update={"rig": rig}), eye, places[:, 1] * 320 + places[:, 0])
    rays = rig.rays(places.astype(float), eye)
    length = np.linalg.norm(rays, axis=-1)
    ambient = environment_radiance(frame.environment)
    # Float32.
    np.testing.assert_allclose(got[1], ambient.extinction_per_m * length, rtol=1e-6)
    directions = frame.world_from_left.rotate(rays / length[:, None]).astype(np.float32)
    # Linear interpolation over 32 px, 7 degrees, of air that varies over tens of degrees.
    np.testing.assert_allclose(got[0], ambient.airlight(directions[None])[0], rtol=0.005)
