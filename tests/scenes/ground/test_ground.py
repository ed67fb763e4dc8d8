"""Land and sea: levels, band limits, the statistics of waves and of the sun's glint."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from datasets_manifest.types.environment import GROUND_KINDS, Environment
from scenes.ground.ground_radiance import MEAN_REFLECTANCE, Ground
from scenes.ground.land_tiles import land_textures
from scenes.ground.sea import GroundLight, Sea, fresnel, longest_wave_m, slope_variances
from scenes.ground_view import FARTHEST_M, GroundView, MipTile, ground_view, pixel_angle_rad, power_noise
from scenes.sky.photometry import luminance


def environment(kind: str, **changes: float) -> Environment:
    values = {
        "sun_elevation_deg": 40.0,
        "sun_azimuth_deg": 60.0,
        "turbidity": 2.5,
        "visibility_m": 150_000.0,
        "altitude_m": 3000.0,
        "ground": kind,
        "ground_reflectance_rgb": MEAN_REFLECTANCE[kind],
        "ground_texture_seed": 3,
    }
    return Environment.model_validate(values | changes)


def light(
    sky_cd_m2: float = 2000.0, beam_lux: float = 60_000.0, elevation_deg: float = 40.0, azimuth_deg: float = 0.0
) -> GroundLight:
    e, a = np.radians([elevation_deg, azimuth_deg])
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return GroundLight(
        np.full(3, np.pi * sky_cd_m2),
        direction,
        np.full(3, beam_lux),
        lambda directions: np.full(directions.shape, sky_cd_m2, dtype=np.float32),
    )


def rays(depression_deg: float, half_width_deg: float = 8.0, rows: int = 60, columns: int = 160) -> np.ndarray:
    """A level picture whose middle looks down by so much, towards the east."""
    azimuth = np.radians(np.linspace(half_width_deg, -half_width_deg, columns))
    down = np.radians(depression_deg) + np.radians(np.linspace(-0.4, 0.4, rows) * half_width_deg)
    d, a = np.meshgrid(down, azimuth, indexing="ij")
    grid = np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), -np.sin(d)], axis=-1)
    return grid.astype(np.float32)


@pytest.mark.parametrize("kind", GROUND_KINDS)
def test_is_a_function_of_environment_and_direction(kind: str) -> None:
    directions = rays(12.0, rows=24)
    one, two = (Ground(environment(kind), light()).radiance(directions) for _ in range(2))
    assert np.isfinite(one).all() and (one >= 0).all()
    np.testing.assert_array_equal(one, two)
    other = Ground(environment(kind, ground_texture_seed=4), light()).radiance(directions)
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("kind", ["fields", "forest", "dry"])
def test_land_reflects_what_it_should_on_average(kind: str) -> None:
    """Over many kilometres the picture averages to the environment's reflectance."""
    above = rays(50.0, 25.0)
    lit = light()
    seen = [Ground(environment(kind, ground_texture_seed=seed), lit).radiance(above) for seed in range(6)]
    mean = np.mean(seen, axis=(0, 1, 2))
    want = np.array(MEAN_REFLECTANCE[kind]) * lit.level_lux / np.pi
    # Six views of 6 km hold a thousand parcels, but few large woods, rivers and hills: about a tenth either way.
    np.testing.assert_allclose(mean, want, rtol=0.15)


def test_dark_light_makes_dark_ground_and_towns_light_up() -> None:
    directions = rays(12.0, rows=24)
    day, dusk = (Ground(environment("fields"), light(s, b)).radiance(directions) for s, b in ((2000, 6e4), (2, 60)))
    np.testing.assert_allclose(luminance(dusk).mean() / luminance(day).mean(), 1e-3, rtol=1e-3)
    night = Ground(environment("town"), light(1e-3, 0.0)).radiance(directions)
    assert luminance(night).max() > 30 * 1e-3


def test_a_tile_is_averaged_over_the_footprint() -> None:
    """White noise over n texels squared keeps 1 / n of its standard deviation; bilinear steps blur on."""
    tile = MipTile(power_noise(1, "test", 512, 0.0, 1.0)[..., None], 1.0)
    x, y = np.meshgrid(np.linspace(0, 5000, 300, dtype=np.float32), np.linspace(0, 5000, 300, dtype=np.float32))
    deviations = [float(tile.sample(x, y, np.full_like(x, width)).std()) for width in (4.0, 16.0)]
    # Bilinear interpolation keeps 2/3 of the deviation on average over places; 16 texels leave 1e3 independent ones.
    np.testing.assert_allclose(deviations, [2 / 3 / 4, 2 / 3 / 16], rtol=0.1)


@pytest.mark.parametrize("is_coded", [False, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_means_along_lines_are_those_of_interpolated_levels(channels: int, is_coded: bool) -> None:
    """Linear between texels by SciPy, between levels by the logarithm of the width, and a mean over the places."""
    rng = np.random.default_rng(channels)
    texels, texel_m, places = rng.random((64, 64, channels), dtype=np.float32), 0.5, 3
    x_m, y_m, along_x_m, along_y_m = rng.uniform(-100, 100, (4, 40, 5)).astype(np.float32)
    # From finer than the texels to coarser than the coarsest level, of 8 texels a side.
    width_m = np.geomspace(0.1, 30, 200, dtype=np.float32).reshape(40, 5)
    found = MipTile(texels, texel_m, is_coded).sample_along((x_m, y_m), (along_x_m, along_y_m), width_m, places)

    x_m, y_m, along_x_m, along_y_m = (part.astype(np.float64) for part in (x_m, y_m, along_x_m, along_y_m))
    levels = [texels]
    while len(levels[-1]) > 8:
        side = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(side, 2, side, 2, channels).mean(axis=(1, 3)))
    shares = np.clip(np.log2(width_m.astype(np.float64) / texel_m), 0, len(levels) - 1)
    expected = np.zeros((40, 5, channels))
    for step in (np.arange(places) + 0.5) / places - 0.5:
        for number, level in enumerate(levels):
            texel = [
                (along + step * way) / (texel_m * 2**number) - 0.5
                for along, way in ((y_m, along_y_m), (x_m, along_x_m))
            ]
            # The two finest levels are kept, and interpolated, as square roots.
            power = 2 if is_coded and number < 2 else 1
            values = [
                map_coordinates(level[..., c] ** (1 / power), texel, order=1, mode="grid-wrap") ** power
                for c in range(channels)
            ]
            weight = np.maximum(1 - np.abs(shares - number), 0) / places
            expected += weight[..., None] * np.stack(values, axis=-1)
    # A root in eight bits is off by up to half of 1/255, and its square by twice that, 0.004. The others carry some
    # roundings of float32.
    np.testing.assert_allclose(found, expected, atol=0.004 if is_coded else 1e-6)


def test_a_tile_repeats_without_a_seam() -> None:
    tile = land_textures("fields").rgb
    x = np.linspace(8192 - 40, 8192 + 40, 81, dtype=np.float32)[None].repeat(3, axis=0)
    y = np.full_like(x, 777.0)
    width = np.full_like(x, 16.0)
    np.testing.assert_allclose(tile.sample(x, y, width), tile.sample(x - 8192, y, width), atol=1e-5)


def test_far_ground_does_not_shimmer() -> None:
    """Half a pixel's shift changes distant ground by less than near ground: detail is left out before it aliases."""
    ground = Ground(environment("town", altitude_m=1000.0), light())
    changes = []
    for depression in (20.0, 4.0):
        directions = rays(depression, 2.0)
        moved = 0.5 * (directions[:, 1:] + directions[:, :-1])
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        seen = luminance(ground.radiance(directions))
        between = luminance(ground.radiance(moved))
        straight = 0.5 * (seen[:, 1:] + seen[:, :-1])
        changes.append(np.abs(between - straight).mean() / seen.mean())
    assert changes[1] < changes[0] < 0.25


def test_no_seam_between_bands_of_rows() -> None:
    """Rows are computed in bands; a flat tone must not change from one to the next."""
    ground = Ground(environment("sea", altitude_m=6000.0, wind_speed_m_s=1.0), light(beam_lux=0.0))
    rows = luminance(ground.radiance(rays(25.0, 6.0, rows=120))).mean(axis=1)
    steps = np.abs(np.diff(rows)) / rows[:-1]
    assert steps.max() < 6 * np.median(steps) + 0.01


def test_fresnel_is_that_of_water() -> None:
    assert float(fresnel(np.array(1.0))) == pytest.approx(((1.34 - 1) / (1.34 + 1)) ** 2)
    assert float(fresnel(np.array(1e-6))) == pytest.approx(1.0, abs=1e-4)
    brewster = np.arctan(1.34)
    inside = np.arcsin(np.sin(brewster) / 1.34)
    # At Brewster's angle one polarisation is gone.
    want = 0.5 * (np.sin(brewster - inside) / np.sin(brewster + inside)) ** 2
    assert float(fresnel(np.cos(brewster))) == pytest.approx(want, rel=1e-9)


def test_slopes_are_those_of_cox_and_munk() -> None:
    """Total mean square slope 0.003 + 0.00512 U (their equation for clean seas), within the fit's own 0.004."""
    for wind in (2.0, 7.0, 14.0):
        assert sum(slope_variances(wind)) == pytest.approx(0.003 + 0.00512 * wind, abs=0.004)


def test_waves_grow_with_the_wind() -> None:
    """A fully grown sea under 10 m/s has its peak at a period of 7.3 s, which deep water gives 83 m."""
    assert longest_wave_m(10.0) == pytest.approx(9.81 / (2 * np.pi) * (2 * np.pi * 10.0 / (0.877 * 9.81)) ** 2)
    assert longest_wave_m(10.0) == pytest.approx(83.0, abs=1.0)
    lengths = []
    for wind in (5.0, 10.0):
        sea = Sea(light(), wind, 0.0)
        x_m = np.arange(4096, dtype=np.float32)[None] * np.float32(0.5)
        straight = np.ones_like(x_m)
        view = GroundView(x_m, 0 * x_m + 100.0, straight, 0 * x_m, straight, straight / 2, straight / 2, 1)
        slope = sea._waves(view)[0][0]
        heights = np.fft.rfft(slope * np.hanning(slope.size))[1:] / np.arange(1, slope.size // 2 + 1)
        power = np.abs(heights) ** 2
        lengths.append(2048.0 / float((power * np.arange(1, power.size + 1)).sum() / power.sum()))
    assert 2.5 < lengths[1] / lengths[0] < 6.0  # four, as the square of the wind, within one line's chance


def test_patches_of_wind_are_darker_or_brighter_by_their_slopes() -> None:
    """Under a sky that is bright at the horizon rough water mirrors its darker upper part, as another table says."""
    lit = GroundLight(
        np.full(3, 6000.0),
        np.array([0.0, 0.0, 1.0]),
        np.zeros(3),
        lambda directions: np.repeat(4000.0 - 3000.0 * np.abs(directions[..., 2:]), 3, axis=-1).astype(np.float32),
    )
    sea = Sea(lit, 7.0, 0.0)
    view = ground_view(rays(10.0, 4.0), 3000.0, 1e-3)
    still = np.zeros_like(view.x_m)
    calm, mean, rough = (sea._mirrored_sky(view, still, still + np.float32(gust))[..., 0] for gust in (0.4, 1.0, 1.9))
    assert calm.mean() > 1.1 * mean.mean() > 1.1 * 1.1 * rough.mean()
    sea._smooth = sea._rough = sea._sky_table(1.0)
    np.testing.assert_allclose(mean, sea._mirrored_sky(view, still, still + 1)[..., 0], rtol=0.03)


def test_swell_runs_in_its_own_direction() -> None:
    """Slopes along the crests of a swell are a small part of those along its way."""
    sea = Sea(light(), 7.0, 0.0, swell_rad=0.9, swell=1.0)
    place = np.arange(256, dtype=np.float32) * 20.0
    x_m, y_m = np.meshgrid(place, place)
    straight = np.ones_like(x_m)
    view = GroundView(x_m, y_m, straight, 0 * x_m, straight, straight, straight, 1)
    slope_x, slope_y = sea._with_swell(view, 0 * x_m, 0 * x_m)
    np.testing.assert_allclose(slope_y, np.tan(0.9) * slope_x, rtol=1e-4, atol=1e-8)
    assert float(np.hypot(slope_x, slope_y).std()) == pytest.approx(0.022 * 0.6, rel=0.15)  # their size is half-normal
    across = np.roll(slope_x, -4, axis=0) - slope_x, np.roll(slope_x, -4, axis=1) - slope_x
    assert across[0].std() > across[1].std()  # steps north cross more crests than steps east


def test_a_calm_sea_mirrors_the_sky() -> None:
    """From straight above, unruffled water returns the sky's radiance times Fresnel's share."""
    ground = Ground(environment("sea", wind_speed_m_s=0.0), light(beam_lux=0.0))
    seen = ground.radiance(rays(85.0, 2.0)).mean(axis=(0, 1))
    lit = light(beam_lux=0.0)
    body = np.array(MEAN_REFLECTANCE["sea"]) * lit.level_lux / np.pi
    want = 2000 * float(fresnel(np.array(1.0))) + body
    # The remaining slopes of a calm sea (variance 0.004) add a little.
    np.testing.assert_allclose(seen, want, rtol=0.03)


def test_the_glint_holds_the_suns_light() -> None:
    """Integrated over the half sphere of views, weighted with the sine, the glint gives back R E sin(elevation)."""
    lit = light(beam_lux=1e5, elevation_deg=60.0)
    sea = Sea(lit, 5.0, 0.3)
    step = np.radians(1.0)
    down = np.arange(20.5, 90.0, 1.0)
    azimuth = np.arange(0.0, 360.0, 1.0)
    d, a = np.meshgrid(np.radians(down), np.radians(azimuth), indexing="ij")
    directions = np.stack([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), -np.sin(d)], axis=-1).astype(np.float32)
    view = ground_view(directions, 3000.0, step)
    still = np.zeros_like(view.x_m)
    glint = sea._glint(view, still, still, np.ones_like(still) / np.float32(0.7))[..., 0]
    total = float((glint * np.sin(d) * np.cos(d)).sum() * step * step)
    reflected = total / (1e5 * np.sin(np.radians(60.0)))
    # Incidence of 30 degrees, spread by slopes of 0.12: Fresnel's share there is flat within some percent.
    assert reflected == pytest.approx(float(fresnel(np.cos(np.radians(30.0)))), rel=0.06)


def test_glint_lies_under_the_sun_and_widens_with_the_wind() -> None:
    widths = []
    for wind in (2.0, 12.0):
        ground = Ground(environment("sea", wind_speed_m_s=wind), light(elevation_deg=30.0))
        row = luminance(ground.radiance(rays(30.0, 40.0, rows=24, columns=321))).mean(axis=0)
        bright = row - row.min()
        places = np.linspace(-1, 1, 321)
        assert abs(float((bright * places).sum() / bright.sum())) < 0.1
        widths.append(float((bright > bright.max() / 2).mean()))
    assert widths[1] > 1.3 * widths[0]


def test_a_coast_has_both_and_a_bright_line_between() -> None:
    seen = Ground(environment("coast", ground_texture_seed=5, altitude_m=1500.0), light()).radiance(rays(9.0, 16.0))
    blue = seen[..., 2] / seen[..., 0]
    assert (blue > 1.2).mean() > 0.05 and (blue < 0.8).mean() > 0.05


def test_red_things_lie_about() -> None:
    """Red roofs: what a search for red discs must not fall for."""
    near = rays(45.0, 10.0, 400, 400)
    for kind in ("town", "fields"):
        shares = []
        for seed in range(8):
            seen = Ground(environment(kind, altitude_m=4000.0, ground_texture_seed=seed), light()).radiance(near)
            shares.append(((seen[..., 0] > 3 * seen[..., 1]) & (seen[..., 0] > 3 * seen[..., 2])).mean())
        assert max(shares) > 0


def test_rays_that_miss_the_ground_see_its_rim() -> None:
    directions = rays(0.0, 1.0)
    view = ground_view(directions, 3000.0, pixel_angle_rad(directions))
    assert np.isfinite(view.x_m).all() and float(view.x_m.max()) <= FARTHEST_M * 1.001
