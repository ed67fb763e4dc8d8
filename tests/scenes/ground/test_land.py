"""Hills, shadows, lamps and clouds' shadows of land, against closed forms and independent computations."""

from __future__ import annotations

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.types.environment import CloudLayer
from scenes.environment_radiance import EnvironmentRadiance
from scenes.ground import land_cover, land_tiles, sea
from scenes.ground.ground_radiance import Ground
from scenes.ground.land_cover import LandCover, Regions
from scenes.ground.land_painting import LandKind
from scenes.ground.land_tiles import (
    BEAM_SCALE,
    LAMP_CD,
    LAMP_PEAK_CD_M2,
    SUN_TANGENTS,
    _beam_shares,
    lamp_texture,
    land_textures,
)
from scenes.ground.terrain import Terrain
from scenes.ground_view import GroundView, MipTile, pixel_angle_rad
from scenes.sky.photometry import luminance
from tests.scenes.ground.test_ground import environment, light, rays

SHIFT_M = np.array([1200.0, -700.0], dtype=np.float32)


def everywhere(side_m: float, count: int, width_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions of a grid over a square, and a width."""
    line = (np.arange(count, dtype=np.float32) + 0.5) * np.float32(side_m / count)
    x, y = np.meshgrid(line, line)
    return x, y, np.full_like(x, width_m)


@pytest.mark.parametrize("width_m", [4.0, 64.0])
def test_shadows_keep_the_mean_reflectance(width_m: float) -> None:
    """The sun's light times the reflectance is on average what level ground reflects, at every distance."""
    textures = land_textures("fields")
    grid = everywhere(8192.0, 256, width_m)
    rgb, beam = (tile.sample(*grid) for tile in (textures.rgb, textures.beam))
    for index in range(len(SUN_TANGENTS)):
        mean = (rgb.mean(axis=-1) * beam[..., index]).mean() * BEAM_SCALE / rgb.mean()
        # Averages of products differ from products of averages where trees are dark and shaded: a few percent.
        assert mean == pytest.approx(1.0, abs=0.06)


def test_a_shadow_is_as_long_as_the_house_is_high_over_the_suns_tangent() -> None:
    height = np.zeros((64, 64), dtype=np.float32)
    texel_m, house_m = 4.0, 12.0
    height[20:40, 30:36] = house_m
    shares = _beam_shares(height, texel_m, np.ones_like(height))
    # The middle tangents only: the longest shadow needs more steps, the shortest is a texel.
    lengths = []
    for index in (0, 1):
        row = shares[30, :30, index]
        lengths.append(float((1.0 - np.minimum(row / row[0], 1.0)).sum()) * texel_m)
    # Heights are looked up at distances up to 30 % apart, and penumbras are drawn a third of the tangent wide.
    np.testing.assert_allclose(lengths, house_m / np.array(SUN_TANGENTS[:2]), rtol=0.2)
    # The sun stands towards the columns: nothing is dark there.
    assert shares[30, 40, 0] == shares[0, 0, 0]


@pytest.mark.parametrize("kind", ["fields", "town"])
def test_lamps_send_out_their_light_at_every_distance(kind: LandKind) -> None:
    texel_m = 2.5 if kind == "town" else 4.0
    side_m = 2048 * texel_m
    expected = len(land_textures(kind).lamps_px) * LAMP_CD / side_m**2
    for width_m in (texel_m, 40.0, 400.0):
        seen = lamp_texture(kind).sample(*everywhere(side_m, 1024, width_m)) * LAMP_PEAK_CD_M2
        # Eight bits lose the faint rims of pools of light, hundreds of lamps differ by 5 %, and few outshine the scale.
        assert float(luminance(seen).mean()) == pytest.approx(expected, rel=0.12)


def test_land_without_lamps_is_dark() -> None:
    assert not land_textures("forest").lamps_px.size
    assert not lamp_texture("forest").sample(*everywhere(2048 * 4.0, 64, 40.0)).any()


def test_lamps_stand_apart_and_differ() -> None:
    seen = lamp_texture("town").sample(*everywhere(800.0, 320, 2.5))
    level = luminance(seen)
    bright = level > 8 * level.mean()
    assert 0.001 < bright.mean() < 0.06
    blue_over_red = seen[bright][:, 2] / np.maximum(seen[bright][:, 0], 1e-6)
    assert blue_over_red.min() < 0.4 < 0.8 < blue_over_red.max()


def test_level_land_is_met_where_a_plane_is() -> None:
    """Without hills the profiles give back altitude over sine."""
    level = Terrain("fields", 800.0, SHIFT_M, False, lambda x, y: np.zeros_like(x))
    directions = rays(9.0, 8.0)
    seen = level.seen(directions, pixel_angle_rad(directions), (0.0, 0.0))
    # Table positions are rounded to 1/32 of a pixel.
    np.testing.assert_allclose(seen.distance_m, 800.0 / -directions[..., 2], rtol=2e-3)
    np.testing.assert_allclose(seen.sine, -directions[..., 2], rtol=0.1)
    assert (seen.share == 1.0).all()


def test_profiles_between_directions_are_as_good_as_one_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    """Heights between profiles are interpolated: the outline errs by less, the more profiles pass over a piece."""
    directions = rays(1.0, 16.0, rows=240, columns=640)
    terrain = Terrain("mountains", 3000.0, SHIFT_M, False)

    def outline_px(profiles: int) -> np.ndarray:
        monkeypatch.setattr("scenes.ground.terrain._PROFILES_PER_PIECE", profiles)
        return terrain.seen(directions, pixel_angle_rad(directions), (0.0, 0.0)).share.sum(axis=0)

    errors_px = [np.abs(outline_px(profiles) - outline_px(1000)) for profiles in (1, 2, 6)]
    print([error.mean() for error in errors_px], errors_px[-1].max())
    assert errors_px[0].mean() > 2 * errors_px[1].mean() > 4 * errors_px[2].mean()
    assert errors_px[2].max() < 0.1


def test_the_first_hill_in_the_way_is_seen() -> None:
    """Against a march along single rays in steps of 10 m."""
    altitude_m = 2000.0
    terrain = Terrain("mountains", altitude_m, SHIFT_M, False)
    directions = rays(5.0, 6.0, 40, 60)
    seen = terrain.seen(directions, pixel_angle_rad(directions), (0.0, 0.0))
    steps = np.arange(500.0, 60_000.0, 10.0, dtype=np.float32)
    errors = []
    for row, column in ((36, 10), (32, 30), (36, 50), (24, 20), (28, 40), (20, 5), (20, 45), (24, 55), (30, 1)):
        ray = directions[row, column]
        x, y = (ray[axis] * steps[None] for axis in (0, 1))
        height, _ = terrain.heights(x, y, np.maximum(0.02 * steps[None], 60.0).astype(np.float32))
        below = np.flatnonzero(altitude_m + ray[2] * steps < height[0])
        assert len(below) > 0
        errors.append(abs(seen.distance_m[row, column] / steps[below[0]] - 1.0))
    # Profiles have a sample every 2 % of the way; a ray that grazes a crest may be taken for one that passes it.
    assert np.median(errors) < 0.02 and np.mean(np.array(errors) > 0.1) < 0.3


def test_hills_stand_out_against_the_sky() -> None:
    around = EnvironmentRadiance(environment("mountains", altitude_m=300.0, visibility_m=60_000.0))
    directions = rays(-1.0, 16.0, 60, 160)
    met = around.ground.seen(directions)
    assert met is not None
    above = directions[..., 2] > 0.003
    hill = above & (met.share == 1.0)
    assert hill.mean() > 0.005
    seen = luminance(around.radiance(directions))
    rows = directions[..., 2].round(3)
    for row in np.unique(rows[hill])[:10]:
        same = (rows == row) & above
        sky = seen[same & (met.share == 0.0)]
        if len(sky):
            assert seen[same & hill].mean() < sky.mean()


def test_trees_stand_above_the_horizon_of_a_low_camera() -> None:
    directions = rays(0.5, 12.0, 60, 160)
    for altitude_m, expected in ((12.0, True), (3000.0, False)):
        met = Ground(environment("fields", altitude_m=altitude_m), light()).seen(directions)
        assert met is not None
        assert bool((met.share[directions[..., 2] > 0.002] > 0.5).any()) is expected


def test_no_walls_stand_on_dry_land_below_a_low_camera() -> None:
    """Dry hills slope by 0.13, and by three times as much in a hundred places: 20 degrees, a sine of 0.35.

    With the heights of hummocks on them, as if they were trees, four of five rays met sides steeper than that.
    """
    met = Ground(environment("dry", altitude_m=60.0), light()).seen(rays(4.0))
    assert met is not None
    near = (met.distance_m < 1500.0) & (met.share == 1.0)
    assert near.mean() > 0.3
    assert np.mean(met.sine[near] > 0.4) < 0.01


def test_walls_are_steep_and_roofs_are_not() -> None:
    """Between texels of 2.5 m a wall rises by seven tenths of a house within 1.2 m, and most of a roof by a tenth.

    Interpolated heights rose by less than half and by a quarter: houses looked like tents.
    """
    town = LandCover(environment("town", altitude_m=60.0), np.random.default_rng(1), light().beam_direction)
    x, y, width = everywhere(1200.0, 2000, 0.5)
    zero, one = np.zeros_like(x), np.ones_like(x)
    # Far from roads, rivers and the outskirts.
    signs, per_m, moved = (np.full((*x.shape, count), value, np.float32) for count, value in ((4, 1), (3, 0), (2, 0)))
    regions = Regions(signs, per_m, moved, one, zero, one)
    view = GroundView(x, y, one, zero, one, width, width, 1)
    houses_m, built = np.moveaxis(town.cover(view, regions, town.axes(regions))[..., [1, 3]], -1, 0)
    assert 0.05 < (built > 0.9).mean() < 0.6
    steps_m = cv2.dilate(houses_m, np.ones((3, 3))) - cv2.erode(houses_m, np.ones((3, 3)))
    roof_m = cv2.dilate(houses_m, np.ones((27, 27)))
    # Without houses beside higher ones.
    low = (houses_m > 1.0) & (roof_m < 9.0)
    rise = steps_m[low] / roof_m[low]
    assert np.median(rise) < 0.15 and np.percentile(rise, 90) > 0.65


def test_nothing_stands_in_the_water() -> None:
    """Neither trees in the sea before a coast nor in the rivers of fields."""
    for kind in ("coast", "fields"):
        seen = 0
        for seed in range(3):
            ground = Ground(environment(kind, altitude_m=80.0, ground_texture_seed=seed), light())
            x, y, width = everywhere(6000.0, 300, 4.0)
            view = GroundView(x - 3000.0, y - 3000.0, *(np.ones_like(x) for _ in range(3)), width, width, 1)
            regions = ground._regions(view)
            if kind == "coast":
                assert ground._coast is not None
                wet = ground._coast.offshore_m(view, regions.signs, regions.moved) > 0.0
            else:
                away_m = abs(regions.signs[..., 0]) / np.maximum(regions.per_m[..., 0], 1.5e-4)
                wet = away_m < 0.5 * ground._cover._river_m
            cover_m = ground._cover_m(view.x_m, view.y_m, width)
            seen += int(wet.sum())
            # Regions vary slowly, and are known to some metres.
            assert np.sum(cover_m[wet] > 2.0) <= 0.005 * wet.sum()
            assert np.mean(cover_m[~wet] > 2.0) > 0.02
        assert seen > 1000


def test_clouds_shade_the_ground_and_keep_its_mean_light() -> None:
    layer = CloudLayer(height_above_camera_m=900.0, cover_fraction=0.45, feature_size_m=900.0, optical_depth=10.0,
                       texture_seed=1, thickness_m=300.0)  # fmt: skip
    ground = Ground(environment("fields").model_copy(update={"clouds": (layer,)}), light())
    x, y, _ = everywhere(30_000.0, 200, 1.0)
    sunny = ground._sunny(x, y)
    # Some hundred clouds, each as likely as not; those of a dome cover less at the height of the shadow.
    assert sunny.min() < 0.1 and sunny.mean() == pytest.approx(1.0, abs=0.25)
    assert (Ground(environment("fields"), light())._sunny(x, y) == 1.0).all()


def test_kept_textures_are_those_that_were_painted() -> None:
    rng = np.random.default_rng(5)
    painted = MipTile(rng.random((64, 64, 3), dtype=np.float32), 3.0, coded=True)
    kept = MipTile.from_arrays(painted.to_arrays())
    for width_m in (1.0, 12.0, 150.0):
        places = everywhere(200.0, 70, width_m)
        assert np.array_equal(kept.sample(*places), painted.sample(*places))
    assert (kept.most, *kept.mean) == (painted.most, *painted.mean)


def test_kept_noise_is_that_which_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    textures = {
        land_cover.region_tile: lambda: MipTile(land_cover._region_fields(), land_cover._TEXEL_M),
        land_cover.gradient_tile: land_cover._gradients,
        land_cover.moved_tile: land_cover._moved,
        sea._wave_tile: sea._waves,
    }
    made = [make().to_arrays() for make in textures.values()]
    for _ in range(2):
        for kept, arrays in zip(textures, made, strict=True):
            found = kept.__wrapped__().to_arrays()
            assert all(np.array_equal(found[key], array) for key, array in arrays.items())
        # Each has a file of its own, which the others do not remove.
        assert len([*(tmp_path / "droguekit" / "arrays").iterdir()]) == len(textures)


def test_kept_textures_know_all_code_that_they_follow_from() -> None:
    """The cache itself, and what is compiled to look at textures, change nothing of them."""
    top = Path(land_tiles.__file__).parents[2]
    others = {top / name for name in ("datasets_manifest/user_cache.py", "geometry/compiled_loops.py")}
    found, waiting = set(others), {Path(land_tiles.__file__)}
    while waiting:
        found.add(path := waiting.pop())
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = (node.module, *(f"{node.module}.{alias.name}" for alias in node.names))
                paths = {top / f"{name.replace('.', '/')}.py" for name in names}
                waiting |= {each for each in paths - found if each.exists()}
    assert found - others == {Path(source) for source in land_tiles._SOURCES}
