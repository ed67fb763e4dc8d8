from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer, Moon
from datasets_manifest.types.frame import FrameSpec
from datasets_manifest.types.video_camera import VideoCamera, Window
from geometry.distortion import BrownConrady, Lens
from geometry.se3 import exp_twist
from geometry.stereo import EYES, Eye, StereoRig
from render.background import background
from render.camera.optics import glare_spread_per_sr, light_on_sensor, sun_glare
from render.engine import EyeRadiance
from scenes.clouds.cloud_layers import opacity_towards
from scenes.environment_radiance import environment_radiance
from scenes.sampler import sample_frame
from scenes.sky.photometry import SOLAR_ILLUMINANCE_LUX, luminance
from scenes.sky.sky_models import moon_illuminance_lux
from tests.support.recipe_builder import paper_view_recipe


def with_sun(elevation_deg: float, azimuth_deg: float) -> FrameSpec:
    frame = sample_frame(paper_view_recipe(scale=0.25), 0)
    environment = frame.environment.model_copy(
        update={"sun_elevation_deg": elevation_deg, "sun_azimuth_deg": azimuth_deg, "clouds": ()}
    )
    return frame.model_copy(update={"environment": environment})


def eye(frame: FrameSpec, coverage: float = 0.0) -> EyeRadiance:
    shape = (frame.rig.camera.height_px, frame.rig.camera.width_px)
    nothing = np.zeros((*shape, 3), dtype=np.float32)
    full = np.full(shape, coverage, dtype=np.float32)
    return EyeRadiance(
        radiance_cd_m2=nothing,
        coverage=full,
        part_id=np.zeros(shape, dtype=np.uint8),
        depth_m=full,
        normal=nothing,
        amodal_px={},
    )


@pytest.mark.parametrize("fraction", [0.01, 0.1])
def test_the_stated_share_of_the_light_is_scattered(fraction: float) -> None:
    """Integral of the spread over small angles up to a right angle, in closed form and by quadrature."""
    angle = np.geomspace(1e-5, np.pi / 2, 20_000)
    integrand = 2 * np.pi * angle * glare_spread_per_sr(angle.astype(np.float32), fraction)
    total = float(np.sum(0.5 * (integrand[1:] + integrand[:-1]) * np.diff(angle)))
    assert total == pytest.approx(fraction, rel=0.01)  # quadrature in steps of 0.06 %, float32


def test_a_fogged_lens_has_as_much_more_veil() -> None:
    frame = with_sun(14.0, 0.0)
    optics = frame.sensor.optics.model_copy(update={"scattered_fraction": 0.1})
    fogged = frame.model_copy(update={"sensor": frame.sensor.model_copy(update={"optics": optics})})
    # Float32.
    np.testing.assert_allclose(
        sun_glare(fogged, eye(fogged), "left"), 10 * sun_glare(frame, eye(frame), "left"), rtol=1e-5
    )


def test_veil_falls_with_the_square_of_the_angle() -> None:
    frame = with_sun(14.0, 0.0)
    veil = luminance(sun_glare(frame, eye(frame), "left"))
    camera = frame.rig.camera
    v, u = np.unravel_index(np.arange(0, veil.size, 997), veil.shape)
    rays = frame.world_from_left.rotate(camera.rays(np.stack([u, v], axis=-1).astype(float)))
    cosine = rays @ environment_radiance(frame.environment).beam_direction / np.linalg.norm(rays, axis=-1)
    angle = np.arccos(cosine)
    far = angle > 0.06
    slope = np.polyfit(np.log(angle[far]), np.log(veil[v, u][far]), 1)[0]
    # 1 / (a^2 + theta^2) with a = 0.01: the core flattens the slope by a^2 / theta^2, below 3 % here.
    assert slope == pytest.approx(-2.0, abs=0.05)
    # A clear day's veil ten degrees from the sun is a fraction of the sky's own thousands of cd/m2.
    assert 100 < np.median(veil) < 5000


@pytest.mark.parametrize("side", EYES)
def test_the_veil_of_a_lens_is_brightest_where_it_shows_the_sun(side: Eye) -> None:
    frame = with_sun(10.5, 9.0)
    camera = frame.rig.camera
    distortion = BrownConrady(k1=-0.9)
    lenses = Lens(camera, distortion), Lens(camera, distortion, exp_twist([0, 0, 0, 0.02, -0.01, 0.03]).rotation)
    frame = frame.model_copy(update={"rig": StereoRig(camera, 0.12, lenses=lenses)})
    to_sun = frame.world_from_left.inverse().rotate(environment_radiance(frame.environment).beam_direction)
    place = frame.rig.image(to_sun * 1e9, side)
    ideal = camera.project(to_sun)
    assert camera.contains(place, 10.0) and np.abs(place - ideal).max() > 6.5
    veil = luminance(sun_glare(frame, eye(frame), side))
    row, column = np.unravel_index(int(veil.argmax()), veil.shape)
    # The brightest pixel holds the sun.
    np.testing.assert_allclose([column, row], place, atol=1.0)
    # A part before the ideal eye's place of the sun hides nothing; one before the lens's hides it all.
    for covered, reach, is_hidden in ((ideal, 2, False), (place, 4, True)):
        seen = eye(frame)
        u, v = np.rint(covered).astype(int)
        seen.coverage[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1] = 1.0
        hidden = sun_glare(frame, seen, side)
        assert (hidden is None) == is_hidden
        if hidden is not None:
            np.testing.assert_array_equal(luminance(hidden), veil)


def test_a_window_is_as_bright_with_the_sun_just_inside_the_picture_as_just_outside() -> None:
    camera, added = VideoCamera(window=Window(seed=5, scratches=6)), []
    for azimuth_deg in (15.2, 17.2):
        frame = with_sun(10.5, azimuth_deg)
        seen = replace(eye(frame), radiance_cd_m2=background(frame))
        behind = light_on_sensor(frame.model_copy(update={"camera": camera}), seen, "left")
        added.append(luminance(behind - light_on_sensor(frame, seen, "left")).mean())
        assert (seen.radiance_cd_m2.max() > 1e8) == (azimuth_deg < 16)
    # The sky around the sun is part of the view inside; the disc itself would add fifteen times as much.
    assert added[0] == pytest.approx(added[1], rel=0.15)


def test_a_sun_that_a_lens_folds_into_the_image_is_not_hidden_by_what_stands_there() -> None:
    frame = with_sun(10.5, 42.5)
    camera = frame.rig.camera
    to_sun = frame.world_from_left.inverse().rotate(environment_radiance(frame.environment).beam_direction)
    # The polynomial takes the sun from 44 degrees aside to within some 4 of the axis.
    lens = Lens(camera, BrownConrady(k1=-1.0))
    folded = frame.model_copy(update={"rig": StereoRig(camera, 0.12, lenses=(lens, lens))})
    assert camera.contains(folded.rig.real_px(camera.project(to_sun), "left"), 10.0)
    covered, clear = sun_glare(folded, eye(folded, coverage=1.0), "left"), sun_glare(folded, eye(folded), "left")
    assert covered is not None
    np.testing.assert_array_equal(covered, clear)


def test_no_veil_from_behind_at_night_or_from_a_hidden_sun() -> None:
    behind = with_sun(20.0, 180.0)
    assert sun_glare(behind, eye(behind), "left") is None
    night = with_sun(-30.0, 0.0)
    assert sun_glare(night, eye(night), "left") is None
    inside = with_sun(3.0, 0.0)
    assert sun_glare(inside, eye(inside), "left") is not None
    assert sun_glare(inside, eye(inside, coverage=1.0), "left") is None


def test_the_moon_has_a_veil_as_the_sun_has() -> None:
    night, moon = with_sun(-30.0, 0.0), Moon(elevation_deg=14.0, azimuth_deg=0.0, phase_angle_deg=0.0)
    night = night.model_copy(update={"environment": night.environment.model_copy(update={"moon": moon})})
    day = with_sun(14.0, 0.0)
    by_moon, by_sun = (sun_glare(frame, eye(frame), "left") for frame in (night, day))
    assert by_moon is not None and by_sun is not None
    # Float32; the moon's light passes the same air.
    np.testing.assert_allclose(by_moon, by_sun * moon_illuminance_lux(0.0) / SOLAR_ILLUMINANCE_LUX, rtol=1e-5)
    assert light_on_sensor(night, eye(night), "left").max() > 0


def test_clouds_that_a_flying_camera_passes_take_the_glare() -> None:
    frame = with_sun(20.0, 0.0)
    heap = CloudLayer(height_above_camera_m=900.0, cover_fraction=0.45, feature_size_m=900.0, optical_depth=3.0,
                      texture_seed=1, thickness_m=100.0)  # fmt: skip
    clear, beam = sun_glare(frame, eye(frame), "left"), environment_radiance(frame.environment).beam_direction
    shares = []
    for east_m in (0.0, 400.0, 800.0, 1200.0, 1600.0):
        update = {"clouds": (heap,), "camera_offset_m": (east_m, 0.0)}
        passing = frame.model_copy(update={"environment": frame.environment.model_copy(update=update)})
        shares.append(1.0 - opacity_towards(heap, beam, (east_m, 0.0)))
        veil = sun_glare(passing, eye(passing), "left")
        # Float32; a veil by less than 1e-5 lux is left out.
        np.testing.assert_allclose(0.0 if veil is None else veil, shares[-1] * clear, rtol=1e-5, atol=1e-4)
    assert max(shares) - min(shares) > 0.5
