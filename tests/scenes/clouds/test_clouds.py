from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest

from datasets_manifest.types.environment import CloudKind, CloudLayer, Environment, Mist
from scenes.clouds.cloud_density import layer_excess
from scenes.clouds.cloud_layers import (
    CloudLayerRenderer,
    CloudLight,
    LayerGeometry,
    cloud_shape,
    cloud_share,
    diffuse_transmission,
    opacity_towards,
    render_cloud_layer,
)
from scenes.clouds.cloud_textures import ice_tiles, lump_volume, power_law_tile
from scenes.clouds.ray_march import MOST_DEPTH, march_rays
from scenes.environment_radiance import EnvironmentRadiance
from scenes.environment_sampling import environment_of_scene
from scenes.sky.photometry import direction_from_angles, luminance
from tests.support.recipe_builder import RecipeTable, between, build_recipe

ONE_LAYER = {"clouds": {"scene_fraction": 1.0}}
TWO_LAYERS = {
    "clouds": [{"scene_fraction": 1.0}, {"kind": "cirrus", "scene_fraction": 1.0, "optical_depth": 0.4}],
    "mist": {"scene_fraction": 0.5},
    "moon": {"scene_fraction": 1.0},
}


def environment(**changes: Mist | float | tuple[CloudLayer]) -> Environment:
    values = {
        "sun_elevation_deg": 40.0,
        "sun_azimuth_deg": 60.0,
        "turbidity": 2.5,
        "visibility_m": 80_000.0,
        "altitude_m": 3000.0,
        "ground_reflectance_rgb": (0.1, 0.1, 0.06),
        "ground_texture_seed": 3,
    }
    return Environment.model_validate(values | changes)


def layer(**changes: float | str) -> CloudLayer:
    values = {
        "height_above_camera_m": 1000.0,
        "cover_fraction": 0.4,
        "feature_size_m": 1500.0,
        "optical_depth": 14.0,
        "texture_seed": 1,
    }
    return CloudLayer.model_validate(values | changes)


def upwards(count: int = 128, half_width: float = 1.2, sign: float = 1.0) -> np.ndarray:
    """(count, count, 3) directions around the zenith or nadir."""
    x, y = np.meshgrid(np.linspace(-half_width, half_width, count), np.linspace(-half_width, half_width, count))
    rays = np.stack([x, y, np.full_like(x, sign)], axis=-1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("kind", ["cumulus", "congestus", "stratus", "altocumulus"])
@pytest.mark.parametrize("cover", [0.2, 0.6])
def test_cover_is_the_share_of_the_plan(kind: str, cover: float) -> None:
    """Straight up, over many repeats of the pattern."""
    cloud = layer(kind=kind, cover_fraction=cover, thickness_m=500.0, optical_depth=40.0, height_above_camera_m=100.0)
    light = CloudLight(np.array([0.0, 0.0, 1.0]), *np.ones((3, 3)))
    up = np.array([[[0.0, 0.0, 1.0]]], dtype=np.float32)
    rng = np.random.default_rng(4)
    hidden = [
        CloudLayerRenderer(cloud, light, (float(east), float(north))).view(up, 1e-3).opacity[0, 0] > 0.5
        for east, north in rng.uniform(0, 40 * cloud.feature_size_m, (250, 2))
    ]
    # Binomial: a standard deviation of 0.03; lumps and swells move edges, and half of each edge counts as open.
    assert np.mean(hidden) == pytest.approx(cover, abs=0.13)


def test_no_cloud_without_cover_and_no_sky_under_an_overcast() -> None:
    rays = upwards()
    for kind in ("cumulus", "stratus", "cirrus"):
        clear = EnvironmentRadiance(environment()).radiance(rays)
        none = EnvironmentRadiance(environment(clouds=(layer(kind=kind, cover_fraction=0.0),)))
        np.testing.assert_allclose(none.radiance(rays), clear, rtol=1e-3)
    thick = layer(kind="stratus", cover_fraction=1.0, optical_depth=60.0)
    assert opacity_towards(thick, direction_from_angles(40.0, 60.0)) > 0.99


def test_cumulus_is_darker_below_than_on_its_sunny_side() -> None:
    """Seen from above clouds send back most of the sunlight, seen from below they let a part of it through."""
    over, under = (
        luminance(
            EnvironmentRadiance(environment(clouds=(layer(height_above_camera_m=h, cover_fraction=0.9),))).radiance(
                rays
            )
        )
        for h, rays in ((-1000.0, upwards(sign=-1.0)), (1000.0, upwards()))
    )
    clear = EnvironmentRadiance(environment())
    facing_lux = float(luminance(clear.beam_illuminance_lux + clear.air.sky_level_lux))
    # A white, diffuse plane that faces the sun sends 1/pi of the light back; thick cloud 0.5 to 0.9 of that.
    assert 0.5 < np.percentile(over, 90) * np.pi / facing_lux < 0.9
    assert np.median(under) < 0.6 * np.percentile(over, 90)


def test_light_under_an_overcast_is_what_two_streams_let_through() -> None:
    """Level illuminance below against that above: 1 / (1 + 0.11 depth) of it, and none of it from the sun itself."""
    stratus = layer(kind="stratus", cover_fraction=1.0, optical_depth=30.0, thickness_m=400.0)
    open_sky, under = EnvironmentRadiance(environment()), EnvironmentRadiance(environment(clouds=(stratus,)))
    assert luminance(under.beam_illuminance_lux) < 1e-3 * luminance(open_sky.beam_illuminance_lux)
    up = np.array([0.0, 0.0, 1.0])
    share = float(luminance(under.plate_illuminance_lux(up)) / luminance(open_sky.plate_illuminance_lux(up)))
    # The march shades by depth towards the sun, not by two streams: they agree to a third.
    assert share == pytest.approx(diffuse_transmission(stratus), rel=0.35)


def test_edges_towards_the_sun_are_lined_with_silver() -> None:
    """Against the sun thin edges outshine the body of a cloud; with the sun in the back they do not."""
    x, y = np.meshgrid(np.linspace(-0.2, 0.2, 160), np.linspace(0.1, 0.4, 120))
    rays = np.stack([np.ones_like(x), -x, y], axis=-1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    ratios = []
    for azimuth_deg in (10.0, 190.0):
        sun = direction_from_angles(25.0, azimuth_deg)
        light = CloudLight(sun, np.full(3, 8e4), np.full(3, 1.5e4), np.full(3, 5e3))
        seen = render_cloud_layer(layer(cover_fraction=0.5), rays, light)
        brightness = luminance(seen.radiance)
        edge = (seen.opacity > 0.2) & (seen.opacity < 0.8)
        ratios.append(brightness[edge].mean() / brightness[seen.opacity > 0.99].mean())
    # The forward peak at 15 degrees, 0.7 / sr, against the 0.3 / sr of everything that is scattered more often.
    assert ratios[0] > 1.5 and ratios[1] < 1.2


def test_coarse_march_agrees_with_every_ray() -> None:
    """A large picture is seen on every second ray and marched on every fourth but for edges."""
    around = EnvironmentRadiance(environment(clouds=(layer(),)))
    rays = upwards(count=320, half_width=0.2)
    large = luminance(around.radiance(rays))
    parts = np.concatenate([luminance(around.radiance(rays[row : row + 80])) for row in range(0, 320, 80)])
    # Finest knobs of 2 m are 6 rays wide here; interpolation over 2 to 4 rays blunts them and edges.
    assert np.mean(np.abs(large / parts - 1)) < 0.03
    assert large.mean() == pytest.approx(parts.mean(), rel=0.01)


def test_mist_hides_sun_and_sky_and_thins_out_in_the_limit() -> None:
    rays = upwards()
    clear = EnvironmentRadiance(environment())
    thin = EnvironmentRadiance(environment(mist=Mist(visibility_m=100_000, above_m=0.1, below_m=0.1)))
    # At most 8e-6 of the mist's light, which in red is some 20 times the bluest sky's.
    np.testing.assert_allclose(thin.radiance(rays), clear.radiance(rays), rtol=2e-4)
    dense = EnvironmentRadiance(environment(mist=Mist(visibility_m=50, above_m=300, below_m=300)))
    assert luminance(dense.beam_illuminance_lux) < 1e-6
    seen = luminance(dense.radiance(rays))
    assert seen.std() / seen.mean() < 1e-3
    # Under optical depth 23.5 two streams leave 1 / 3.6; three quarters of it shine from all around.
    assert float(seen.mean()) == pytest.approx(
        0.75 / np.pi / 3.58 * float(luminance(clear.ground_illuminance_lux)), rel=0.02
    )


@pytest.mark.parametrize("kind", get_args(CloudKind))
@pytest.mark.parametrize("height_m", [800.0, -800.0])
def test_finite_everywhere_at_any_hour(kind: str, height_m: float) -> None:
    if kind == "rain":
        height_m = abs(height_m)
    rng = np.random.default_rng(3)
    rays = rng.standard_normal((20, 20, 3))
    rays[0, 0] = [1.0, 0.0, 0.0]
    rays[0, 1] = [0.0, 0.0, -1.0]
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    for elevation in (60.0, 0.5, -4.0, -30.0):
        around = EnvironmentRadiance(
            environment(sun_elevation_deg=elevation, clouds=(layer(kind=kind, height_above_camera_m=height_m),))
        )
        seen = around.radiance(rays)
        assert np.isfinite(seen).all() and (seen > 0).all()


def test_recipes_with_one_layer_still_read_and_draw_the_same_sky() -> None:
    base: RecipeTable = {
        "name": "weather-test",
        "frames": {"count": 10, "scenes": 10},
        "distance": between(3.0, 10.0),
    }
    one, two = (build_recipe(base, environment=weather).environment for weather in (ONE_LAYER, TWO_LAYERS))
    assert len(one.clouds) == 1 and len(two.clouds) == 2
    for scene in range(6):
        first, second = environment_of_scene(1, scene, one), environment_of_scene(1, scene, two)
        assert first.sun_azimuth_deg == second.sun_azimuth_deg
        assert second.clouds[0] == first.clouds[0]
        assert second.clouds[1].kind == "cirrus" and second.moon is not None
    mists = [environment_of_scene(1, scene, two).mist for scene in range(40)]
    # Half of them: binomial with standard deviation 3.2; four of them.
    assert abs(sum(mist is not None for mist in mists) - 20) < 13


def test_layers_the_camera_would_touch_are_refused() -> None:
    with pytest.raises(ValueError, match="inside, use mist"):
        layer(height_above_camera_m=50.0)


def looking(width: int, height: int, focal_px: float, elevation_deg: float) -> np.ndarray:
    """(height, width, 3) directions of a pinhole that looks east and up."""
    u, v = np.meshgrid(np.arange(width) - width / 2 + 0.5, np.arange(height) - height / 2 + 0.5)
    cosine, sine = np.cos(np.radians(elevation_deg)), np.sin(np.radians(elevation_deg))
    rays = np.stack([focal_px * cosine + v * sine, -u, focal_px * sine - v * cosine], axis=-1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


SIDE_LIGHT = CloudLight(direction_from_angles(40.0, 60.0), np.full(3, 8e4), np.full(3, 1.5e4), np.full(3, 5e3))


def bare(light: np.ndarray, distance_m: np.ndarray, indices: np.ndarray) -> np.ndarray:
    return light


def test_textures_repeat_without_a_seam() -> None:
    """The step from the last texel to the first is like that between others."""
    tiles = [power_law_tile(5, "texture", 2.6), *ice_tiles(5)]
    for values in [*tiles, np.moveaxis(lump_volume(), 0, 1)]:
        for axis in (0, 1):
            inner = np.abs(np.diff(values, axis=axis)).mean()
            seam = np.abs(np.take(values, 0, axis) - np.take(values, -1, axis)).mean()
            assert seam < 1.5 * inner


def test_cirrus_thins_out_smoothly() -> None:
    """Its depth has no two heaps, nothing and all: Sarle's coefficient is 0.56 for even spread, 0.33 for normal."""
    coefficients = []
    for seed in range(4):
        # Under less cover the open sky makes the distribution skew.
        cirrus = layer(kind="cirrus", height_above_camera_m=4000.0, feature_size_m=4000.0, optical_depth=0.5,
                       cover_fraction=0.7, texture_seed=seed)  # fmt: skip
        opacity = render_cloud_layer(cirrus, looking(160, 120, 800.0, 35.0), SIDE_LIGHT).opacity.ravel()
        centred = (opacity - opacity.mean()) / opacity.std()
        coefficients.append((np.mean(centred**3) ** 2 + 1) / np.mean(centred**4))
    # Hooks of ice in photographs have 0.58 to 0.77 by this measure, and plateaus with ragged edges had 0.66.
    assert np.mean(coefficients) < 0.58


@pytest.mark.parametrize("kind", ["cumulus", "altocumulus"])
def test_edges_of_a_large_picture_are_those_of_single_rays(kind: str) -> None:
    cloud = layer(kind=kind, feature_size_m=900.0, thickness_m=300.0)
    rays = looking(320, 240, 900.0, 25.0)
    renderer = CloudLayerRenderer(cloud, SIDE_LIGHT)
    picture = renderer.picture(rays, bare)[..., 3]
    alone = render_cloud_layer(cloud, rays, SIDE_LIGHT).opacity
    # Puffs smaller than the eighth ray that is marched first may be missed.
    assert np.mean(np.abs(picture - alone) > 0.3) < 0.01
    steepest = [np.abs(np.diff(seen, axis=1)).max(axis=1) for seen in (picture, alone)]
    assert np.median(steepest[0]) > 0.9 * np.median(steepest[1])


@pytest.mark.parametrize("kind", ["cumulus", "altocumulus", "cirrus"])
@pytest.mark.parametrize("behind_cd_m2", [(300.0, 1000.0, 3000.0), (20_000.0, 20_000.0, 20_000.0), (1.0, 1.0, 1.0)])
def test_what_is_seen_of_a_large_picture_is_what_single_rays_see(
    kind: str, behind_cd_m2: tuple[float, float, float]
) -> None:
    """In every channel, before a blue sky, something brighter and something dark."""
    cloud, rays = layer(kind=kind, feature_size_m=900.0, thickness_m=300.0), looking(320, 240, 900.0, 25.0)
    behind = np.broadcast_to(np.array(behind_cd_m2, dtype=np.float32), rays.shape)
    picture = CloudLayerRenderer(cloud, SIDE_LIGHT).picture(rays, bare, behind)
    alone = render_cloud_layer(cloud, rays, SIDE_LIGHT)
    opacity = alone.opacity[..., None]
    single = opacity * alone.radiance + (1.0 - opacity) * behind
    off = np.abs(picture[..., :3] + (1.0 - picture[..., 3:]) * behind - single) / np.maximum(
        single, 0.1 * single.mean()
    )
    # Cumulus, whose finest shreds are as wide as the rays that are interpolated, reaches 0.020 and 0.008.
    assert off.mean(axis=(0, 1)).max() < 0.03
    assert (off > 0.35).mean(axis=(0, 1)).max() < 0.01


@pytest.mark.parametrize("kind", ["cumulus", "congestus"])
def test_rims_before_other_clouds_are_not_lit_like_the_air_between(kind: str) -> None:
    """A ray that grazes one cloud and ends in another sees light of both, not of a place in the open between them."""
    cloud, pixel_rad = layer(kind=kind, thickness_m=900.0, feature_size_m=900.0, cover_fraction=0.5), 1.0 / 400.0
    shape, where, rays = cloud_shape(cloud), LayerGeometry(cloud), looking(320, 240, 400.0, 25.0).reshape(-1, 3)
    place = np.array([0.0, 0.0, where.base_m, where.bend_per_m, pixel_rad, shape.extinction_per_m])

    def marched(from_m: np.ndarray, to_m: np.ndarray) -> np.ndarray:
        found, ends_m = np.zeros((len(rays), 6), dtype=np.float32), np.stack([from_m, to_m], axis=-1)
        march_rays(shape.numbers, shape.body, shape.lumps, rays, ends_m, place, SIDE_LIGHT.direction, found)
        return found

    near_m, far_m = where.crossing(rays[:, 2])
    whole = marched(near_m, far_m)
    between_m = whole[:, 1]
    front, back = marched(near_m, between_m), marched(between_m, far_m)
    places_m = (between_m[:, None] * rays).astype(np.float64)
    places_m[:, 2] += where.bend_per_m * between_m.astype(np.float64) ** 2 - where.base_m
    in_the_open = layer_excess(shape.numbers, shape.body, shape.lumps, places_m, 2.5) < -30.0
    rims = in_the_open & (front[:, 0] > 0.2) & (back[:, 0] > 0.5) & (whole[:, 0] > MOST_DEPTH)
    assert rims.sum() > 500
    depths = np.stack([front[rims, 2], back[rims, 2]])
    # Either half may itself hold more than one cloud.
    low, high = 0.9 * depths.min(axis=0) - 0.05, 1.1 * depths.max(axis=0) + 0.05
    assert np.mean((whole[rims, 2] > low) & (whole[rims, 2] < high)) > 0.99


@pytest.mark.parametrize(("kind", "thickness_m"), [("stratus", 400.0), ("altocumulus", 200.0), ("cumulus", 600.0)])
def test_clouds_near_the_horizon_do_not_sparkle(kind: str, thickness_m: float) -> None:
    """A pixel sees the mean of kilometres of a layer there, and not what one ray happens to meet."""
    cloud, split = layer(kind=kind, thickness_m=thickness_m, cover_fraction=0.6), 5
    renderer, rays = CloudLayerRenderer(cloud, SIDE_LIGHT), looking(160, 40, 1600.0, 0.8)
    finer = renderer.view(looking(160 * split, 40 * split, 1600.0 * split, 0.8), 1.0 / (1600.0 * split))
    whole = (finer.radiance * finer.opacity[..., None]).reshape(40, split, 160, split, 3).mean(axis=(1, 3))
    single = renderer.view(rays, 1.0 / 1600.0)
    off = [
        np.sqrt(np.mean((light - whole) ** 2))
        for light in (renderer.picture(rays, bare)[..., :3], single.radiance * single.opacity[..., None])
    ]
    # The rest is less detail afar, which changes the share of cloud too.
    assert off[0] < 0.9 * off[1]


def test_edges_of_dark_clouds_count_where_it_is_not_known_what_is_behind() -> None:
    """As lamps of a town may be, below clouds by night."""
    cloud, rays = layer(feature_size_m=900.0, thickness_m=300.0), looking(320, 240, 900.0, 25.0)
    night = CloudLight(SIDE_LIGHT.direction, np.zeros(3), np.zeros(3), np.zeros(3))
    alone = render_cloud_layer(cloud, rays, night).opacity
    renderer = CloudLayerRenderer(cloud, night)
    off = [
        np.abs(renderer.picture(rays, bare, behind)[..., 3] - alone).mean() for behind in (None, np.zeros_like(rays))
    ]
    # Before black nothing is seen, so that opacities stay those of every fourth ray.
    assert off[0] < 0.5 * off[1]


def test_a_nearer_layer_is_seen_before_a_farther_one(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def picture(renderer: CloudLayerRenderer, rays: Any, through_air: Any, behind: np.ndarray) -> np.ndarray:
        calls.append((behind.copy(), whole(renderer, rays, through_air, behind)))
        return calls[-1][1]

    whole = CloudLayerRenderer.picture
    monkeypatch.setattr(CloudLayerRenderer, "picture", picture)
    far = layer(kind="altocumulus", height_above_camera_m=3000.0, texture_seed=5)
    EnvironmentRadiance(environment(clouds=(layer(), far))).radiance(looking(320, 240, 900.0, 25.0))
    (sky, farther), (behind, _) = calls
    np.testing.assert_allclose(behind, farther[..., :3] + (1.0 - farther[..., 3:]) * sky, rtol=1e-6)


def test_clouds_in_dense_haze_take_few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    marched = []

    def count(*args: Any) -> None:
        marched.append(len(args[3]))
        march_rays(*args)

    monkeypatch.setattr("scenes.clouds.cloud_layers.march_rays", count)
    cloud, rays = layer(feature_size_m=900.0, thickness_m=300.0), looking(320, 240, 900.0, 25.0)
    sky = np.full(rays.shape, 3000.0, dtype=np.float32)
    for seen in (1.0, 0.005):
        CloudLayerRenderer(cloud, SIDE_LIGHT).picture(
            rays, lambda light, _distance_m, _indices, seen=seen: sky[0, 0] + seen * (light - sky[0, 0]), sky
        )
    # The first two grids alone, where there is haze: every eighth and every fourth ray.
    assert marched[-2:] == [40 * 30, 80 * 60]
    assert sum(marched[:-2]) > 2 * sum(marched[-2:])


@pytest.mark.parametrize("kind", ["cumulus", "congestus", "stratus", "altocumulus"])
def test_shadows_of_clouds_have_soft_edges(kind: str) -> None:
    east_m = np.arange(0.0, 6000.0, 0.5, dtype=np.float32)[None]
    share = cloud_share(layer(kind=kind, feature_size_m=900.0, thickness_m=300.0), east_m, np.zeros_like(east_m))
    assert share.min() == 0.0 and share.max() == 1.0
    # An edge is some 20 m wide, 0.025 a step, and up to twice as steep where bodies are (0.055). A bound in place of
    # the depth made steps of 0.4.
    assert np.abs(np.diff(share)).max() < 0.1


def test_both_eyes_and_all_frames_see_the_same_cloud() -> None:
    """Two views that overlap, as those of two lenses or two moments do, agree where they overlap."""
    cloud = layer()
    wide = looking(320, 240, 500.0, 30.0)
    renderer = CloudLayerRenderer(cloud, SIDE_LIGHT)
    whole, part = renderer.picture(wide, bare), renderer.picture(wide[7:, 13:], bare)
    differ = np.abs(whole[7:, 13:, 3] - part[..., 3])
    # The grid of the rays that are marched first starts elsewhere.
    assert differ.mean() < 0.01 and np.mean(differ > 0.3) < 0.01
    np.testing.assert_array_equal(renderer.picture(wide, bare), whole)


def test_rays_do_not_know_of_each_other() -> None:
    cloud, rays = layer(kind="congestus", thickness_m=900.0), looking(40, 30, 60.0, 30.0)
    renderer = CloudLayerRenderer(cloud, SIDE_LIGHT)
    forwards, backwards = renderer.view(rays, 0.017), renderer.view(rays[::-1, ::-1], 0.017)
    np.testing.assert_array_equal(forwards.radiance, backwards.radiance[::-1, ::-1])
    np.testing.assert_array_equal(forwards.opacity, backwards.opacity[::-1, ::-1])


def test_rain_hangs_from_its_cloud_and_contrails_are_few() -> None:
    rays = looking(160, 120, 130.0, 22.0)
    rain = layer(kind="rain", height_above_camera_m=200.0, thickness_m=1000.0, optical_depth=1.5)
    shafts = render_cloud_layer(rain, rays, SIDE_LIGHT).opacity
    assert shafts[rays[..., 2] < 0].max() == 0.0
    assert shafts.max() > 0.5 and shafts[rays[..., 2] > 0.02].min() < 0.05
    with pytest.raises(ValueError, match="rain must end above"):
        layer(kind="rain", height_above_camera_m=-500.0)
    for cover, most in ((0.0, 0.2), (1.0, 0.7)):
        trails = layer(kind="contrail", height_above_camera_m=5000.0, cover_fraction=cover, feature_size_m=4000.0,
                       optical_depth=1.0)  # fmt: skip
        assert np.mean(render_cloud_layer(trails, rays, SIDE_LIGHT).opacity > 0.1) < most


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_contrails_towards_the_horizon_have_no_spikes(seed: int) -> None:
    """A low ray goes a long way through a trail's height, so that its puffs are seen as their mean."""
    trails = layer(kind="contrail", height_above_camera_m=5000.0, cover_fraction=1.0, feature_size_m=4000.0,
                   optical_depth=0.6, texture_seed=seed)  # fmt: skip
    rays = looking(320, 240, 600.0, 9.0)
    opacity = render_cloud_layer(trails, rays, SIDE_LIGHT).opacity
    low = np.degrees(np.arcsin(rays[..., 2]))
    rows = (low[1:] > 4.6) & (low[1:] < 14.3)
    # A flat layer's rows differ by 0.42 to 0.52 of the mean.
    assert np.abs(np.diff(opacity, axis=0))[rows].mean() < 0.3 * opacity.mean()


def test_patchy_mist_has_its_visibility_here_and_gaps_elsewhere() -> None:
    rays = upwards()
    even, patchy = (
        EnvironmentRadiance(
            environment(mist=Mist(visibility_m=400, above_m=120, below_m=120, patchiness=share, texture_seed=7))
        )
        for share in (0.0, 1.0)
    )
    assert patchy.extinction_per_m == even.extinction_per_m
    ratio = luminance(patchy.radiance(rays)) / luminance(even.radiance(rays))
    assert 0.03 < ratio.std() / ratio.mean() < 0.5
    thin = Mist(visibility_m=400, above_m=1.0, below_m=1.0, patchiness=1.0, texture_seed=7)
    level = Mist(visibility_m=400, above_m=1.0, below_m=1.0)
    seen = [EnvironmentRadiance(environment(mist=mist)).radiance(rays) for mist in (thin, level)]
    # A metre of mist is too little for patches.
    np.testing.assert_allclose(seen[0], seen[1], rtol=0.02)
