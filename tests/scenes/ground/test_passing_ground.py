"""Ground and clouds that a flying camera passes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer, Environment
from scenes.clouds.cloud_layers import CloudLight, render_cloud_layer
from scenes.environment_radiance import EnvironmentRadiance, environment_radiance
from scenes.flight.suspension import WORLD_FROM_TANKER
from scenes.ground.ground_radiance import MEAN_REFLECTANCE, Ground
from scenes.ground.sea import GroundLight
from scenes.sampler import sample_frame
from scenes.sky.photometry import luminance
from tests.support.recipe_builder import between, build_recipe

FOCAL_PX, SIZE_PX = 400.0, 192


def environment(kind: str = "fields", **changes: float | tuple[CloudLayer | float, ...]) -> Environment:
    values = {
        "sun_elevation_deg": 40.0,
        "sun_azimuth_deg": 60.0,
        "turbidity": 2.5,
        "visibility_m": 150_000.0,
        "altitude_m": 1500.0,
        "ground": kind,
        "ground_reflectance_rgb": MEAN_REFLECTANCE[kind],
        "ground_texture_seed": 3,
    }
    return Environment.model_validate(values | changes)


def looking(sign: int, side_px: int = SIZE_PX) -> np.ndarray:
    """(H, W, 3) directions of a pinhole that looks straight up (1) or down (-1); columns go east, rows north."""
    offset = (np.arange(side_px) - (side_px - 1) / 2) / FOCAL_PX
    x, y = np.meshgrid(offset, offset)
    rays = np.stack([x, y, np.full_like(x, sign)], axis=-1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def flow_px(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How far a picture has moved to the right and down, by OpenCV's phase correlation."""
    window = cv2.createHanningWindow(before.shape[::-1], cv2.CV_64F)
    pictures = [np.asarray(picture, dtype=np.float64) - float(np.mean(picture)) for picture in (before, after)]
    return np.array(cv2.phaseCorrelate(*pictures, window)[0])


def light() -> GroundLight:
    direction = np.array([0.6, 0.0, 0.8])
    return GroundLight(np.full(3, 6000.0), direction, np.full(3, 60_000.0), lambda rays: np.full_like(rays, 2000.0))


@pytest.mark.parametrize("kind", ["fields", "forest"])
@pytest.mark.parametrize("flown_m", [(37.5, 0.0), (-22.5, 15.0)])
def test_ground_below_flows_by_focal_length_times_way_over_altitude(kind: str, flown_m: tuple[float, float]) -> None:
    here = environment(kind)
    ground = Ground(here, light())
    there = ground.moved_to(here.model_copy(update={"camera_offset_m": flown_m}))
    before, after = (luminance(seen.radiance(looking(-1))) for seen in (ground, there))
    # East of us is on the right, and what we fly towards comes to the left. A tenth of a pixel is what phase
    # correlation finds of whole shifts under a window.
    np.testing.assert_allclose(flow_px(before, after), -FOCAL_PX * np.array(flown_m) / 1500.0, atol=0.1)
    # The same places: so many whole pixels apart the pictures are the same but for the rounding of places in float32.
    columns, rows = np.rint(FOCAL_PX * np.array(flown_m) / 1500.0).astype(int)
    shifted = np.roll(after, (rows, columns), axis=(0, 1))[40:-40, 40:-40]
    # Wooded hills of 25 m move by a few hundredths of a pixel more or less than the plain.
    assert np.abs(shifted - before[40:-40, 40:-40]).mean() < 0.08 * before.std()


def test_ships_are_passed_as_the_sea_is() -> None:
    flown_m = np.array([60.0, 0.0])
    for seed in range(40):
        here = environment("sea", ground_texture_seed=seed)
        ground = Ground(here, light())
        if ground._ships:
            break
    ship = ground._ships[0]
    above = environment("sea", ground_texture_seed=seed, camera_offset_m=(ship.x_m, ship.y_m))
    pictures = [
        luminance(ground.moved_to(above.model_copy(update={"camera_offset_m": place})).radiance(looking(-1)))
        for place in ((ship.x_m, ship.y_m), (ship.x_m + flown_m[0], ship.y_m))
    ]
    # A quarter of a pixel: the sky's reflection stays where it is.
    np.testing.assert_allclose(flow_px(*pictures), -FOCAL_PX * flown_m / 1500.0, atol=0.25)


def test_clouds_flow_by_their_own_distance() -> None:
    flown_m, height_m = (45.0, -30.0), 1200.0
    shared = {"optical_depth": 3.0, "texture_seed": 4, "feature_size_m": 300.0, "heading_deg": 30.0}
    sun = CloudLight(np.array([0.6, 0.0, 0.8]), np.full(3, 6e4), np.full(3, 6e3), np.full(3, 2e3))
    expected_px = -FOCAL_PX * np.array(flown_m) / height_m
    cirrus = CloudLayer(kind="cirrus", height_above_camera_m=height_m, cover_fraction=0.7, **shared)
    before, after = (render_cloud_layer(cirrus, looking(1), sun, place).opacity for place in ((0.0, 0.0), flown_m))
    # Without depth: as for the ground, but the layer bends with the Earth, by nothing here.
    np.testing.assert_allclose(flow_px(before, after), expected_px, atol=0.15)
    cumulus = CloudLayer(
        kind="cumulus", height_above_camera_m=-height_m, cover_fraction=0.4, thickness_m=100.0, **shared
    )
    before, after = (render_cloud_layer(cumulus, looking(-1), sun, place).opacity for place in ((0.0, 0.0), flown_m))
    # Between that of its tops and that of its base, 100 m farther, and a third of a pixel for edges that change.
    assert np.linalg.norm(flow_px(before, after) - expected_px) < 0.09 * np.linalg.norm(expected_px) + 0.33


def test_clouds_of_a_large_picture_flow_too() -> None:
    # So many rays that clouds are seen on every second one, and enlarged.
    side_px, flown_m, height_m = 256, (48.0, -32.0), 1200.0
    cirrus = CloudLayer(kind="cirrus", height_above_camera_m=height_m, cover_fraction=0.3, feature_size_m=300.0,
                        optical_depth=1.0, texture_seed=4, heading_deg=30.0)  # fmt: skip
    here = environment(clouds=(cirrus,), sun_elevation_deg=20.0)
    there = here.model_copy(update={"camera_offset_m": flown_m})
    before, after = (luminance(environment_radiance(seen).radiance(looking(1, side_px))) for seen in (here, there))
    # Half a pixel: the sky behind stays where it is, and every second ray is interpolated.
    np.testing.assert_allclose(flow_px(before, after), -FOCAL_PX * np.array(flown_m) / height_m, atol=0.5)


CUMULUS = CloudLayer(height_above_camera_m=900.0, cover_fraction=0.45, feature_size_m=900.0, optical_depth=10.0,
                     texture_seed=1, thickness_m=300.0)  # fmt: skip


def test_clouds_that_pass_before_the_sun_take_its_light() -> None:
    here = environment(clouds=(CUMULUS,), sun_elevation_deg=30.0)
    to_sun = environment_radiance(here).beam_direction
    ray = to_sun[None, None].astype(np.float32)
    sun = CloudLight(to_sun, np.full(3, 6e4), np.full(3, 6e3), np.full(3, 2e3))
    clear = environment_radiance(here.model_copy(update={"clouds": ()}))
    clear_disc, open_shares = disc_towards(clear, ray), []
    for east_m in np.arange(0.0, 2500.0, 250.0):
        around = environment_radiance(here.model_copy(update={"camera_offset_m": (float(east_m), 0.0)}))
        open_shares.append(1.0 - float(render_cloud_layer(CUMULUS, ray, sun, (float(east_m), 0.0)).opacity[0, 0]))
        # Float32 radiance.
        expected = clear_disc * open_shares[-1]
        np.testing.assert_allclose(disc_towards(around, ray), expected, rtol=1e-5, atol=1e-5 * clear_disc.max())
        expected_lux = clear.beam_illuminance_lux * open_shares[-1]
        np.testing.assert_allclose(around.beam_illuminance_lux, expected_lux, rtol=1e-9)  # the same float64 product
    assert min(open_shares) < 0.01 and max(open_shares) > 0.99
    # Nothing of the way stays behind.
    np.testing.assert_allclose(disc_towards(environment_radiance(here), ray), clear_disc * open_shares[0], rtol=1e-5)


def disc_towards(around: EnvironmentRadiance, ray: np.ndarray) -> np.ndarray:
    disc = np.zeros((1, 1, 3), dtype=np.float32)
    around.add_discs(disc, ray)
    return disc


def test_sky_and_light_stay_as_they_are() -> None:
    cloud = CloudLayer(height_above_camera_m=-900.0, cover_fraction=0.4, feature_size_m=900.0, optical_depth=10.0,
                       texture_seed=1, thickness_m=300.0)  # fmt: skip
    here = environment(clouds=(cloud,))
    moved = here.model_copy(update={"camera_offset_m": (400.0, 20.0)})
    there, around = environment_radiance(moved), environment_radiance(here)
    assert around is environment_radiance(here)
    np.testing.assert_array_equal(there.light_map, around.light_map)
    np.testing.assert_array_equal(there.radiance(looking(1)), around.radiance(looking(1)))
    assert not np.array_equal(there.radiance(looking(-1)), around.radiance(looking(-1)))
    # Nothing of the way stays behind.
    assert environment_radiance(here).environment.camera_offset_m == (0.0, 0.0)


def test_a_sequence_flies_with_its_airspeed_and_starts_again() -> None:
    recipe = build_recipe(
        name="passing",
        frames={"count": 40, "scenes": 2},
        exposure={"time_s": 0.002},
        sequence={
            "frames_per_sequence": 20,
            "frame_rate_hz": 10,
            "tanker_motion_m": 0,
            "hose": {"preset": "full-size", "airspeed_m_s": 100},
            "turbulence": "none",
            "release_m": [13.8, 0.0, -5],
            "receiver": {"manoeuvres": ["station"], "start_m": 4.0},
        },
    )
    frames = [sample_frame(recipe, index) for index in range(40)]
    places = np.array([frame.environment.camera_offset_m for frame in frames])
    # With a pod that keeps its place, the receiver's own motion is what the poses tell of it.
    eyes = np.array([(WORLD_FROM_TANKER @ frame.left_from_tanker.inverse().translation_m)[:2] for frame in frames])
    flown = np.outer(np.tile(np.arange(20) * 0.1, 2), [100.0, 0.0])
    np.testing.assert_allclose(places, flown + eyes, atol=1e-9)  # rounding of hundreds of metres
    assert np.linalg.norm(places[20] - places[0]) < 1.0
    still = [frame.environment.model_copy(update={"camera_offset_m": (0.0, 0.0)}) for frame in frames]
    assert all(one == still[0] for one in still[:20])


def test_single_pairs_do_not_know_of_flight() -> None:
    recipe = build_recipe(name="single", frames={"count": 1}, distance=between(3, 9))
    assert "camera_offset_m" not in sample_frame(recipe, 0).environment.model_dump()
