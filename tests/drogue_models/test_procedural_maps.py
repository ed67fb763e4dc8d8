"""Building blocks of painted maps: shares, periods and means are those that were asked for, on any grid."""

from __future__ import annotations

import numpy as np
import pytest

from drogue_models.procedural_maps import (
    MapGrid,
    bands,
    cover_share,
    covered,
    dots,
    edge_wear,
    even_paint,
    finished,
    fractal_noise,
    lines,
    panel_tints,
    rivet_rows,
    roundel,
    shaded,
    stitches,
    streaks,
    stripes,
)

GRID = MapGrid(width_m=2.0, height_m=1.0, columns=256, rows=128)
AROUND = MapGrid(width_m=2.0, height_m=1.0, columns=256, rows=128, wraps=True)
FINE = MapGrid(width_m=2.0, height_m=1.0, columns=512, rows=256)
AREA_M2 = 2.0


def halved(layer: np.ndarray) -> np.ndarray:
    """Means over two by two texels."""
    return layer.reshape(layer.shape[0] // 2, 2, layer.shape[1] // 2, 2).mean(axis=(1, 3))


def test_noise_has_mean_0_and_deviation_1() -> None:
    noise = fractal_noise(GRID, 3, 0.3)
    assert noise.mean() == pytest.approx(0.0, abs=1e-12)
    assert noise.std() == pytest.approx(1.0, abs=1e-12)


def test_noise_is_the_same_pattern_on_a_finer_grid() -> None:
    # The smallest of four octaves, 0.04 m, is five texels of the coarse grid.
    coarse, fine = fractal_noise(GRID, 3, 0.3), halved(fractal_noise(FINE, 3, 0.3))
    assert np.corrcoef(coarse.ravel(), fine.ravel())[0, 1] > 0.99


def test_noise_continues_around_a_tube_and_not_on_a_plate() -> None:
    def step_over_the_seam(grid: MapGrid) -> float:
        noise = fractal_noise(grid, 5, 0.3)
        inside = np.abs(np.diff(noise, axis=1)).mean()
        return float(np.abs(noise[:, 0] - noise[:, -1]).mean() / inside)

    assert step_over_the_seam(AROUND) == pytest.approx(1.0, abs=0.4)
    assert step_over_the_seam(GRID) > 3.0


def test_unequal_sizes_of_noise_make_streaks() -> None:
    noise = fractal_noise(GRID, 7, (0.05, 0.8), octaves=2)
    across, along = (np.abs(np.diff(noise, axis=axis)).mean() for axis in (1, 0))
    # A sixteenth as wide as long, and all texels are square.
    assert across / along == pytest.approx(16.0, rel=0.4)


@pytest.mark.parametrize("share", [0.0, 0.03, 0.3, 0.8, 1.0])
def test_cover_takes_its_share(share: float) -> None:
    # Noise is symmetric about its level to first order over the blurred border.
    assert cover_share(fractal_noise(GRID, 3, 0.3), share).mean() == pytest.approx(share, abs=0.01)


def test_edges_wear_first() -> None:
    distance_m = np.broadcast_to(np.minimum(GRID.y_m, 1.0 - GRID.y_m)[:, None], (128, 256))
    worn = edge_wear(GRID, 3, distance_m, reach_m=0.03, share=0.05)
    assert worn.mean() == pytest.approx(0.05, abs=0.01)
    assert worn[distance_m < 0.03].mean() > 20 * worn[distance_m > 0.2].mean()
    chips = worn[:3].mean(axis=0)
    assert chips.min() < 0.5 < chips.max(), "an edge that is worn evenly looks painted"


def test_lines_cover_their_width_however_narrow() -> None:
    places = [0.31, 0.777, 1.5]
    for grid in (GRID, FINE):
        assert lines(grid, places, 0.002).sum(axis=1) * grid.texel_m[0] == pytest.approx(3 * 0.002)
        assert lines(grid, [0.4], 0.05, across=True).mean() == pytest.approx(0.05)
    assert lines(AROUND, [0.0], 0.1)[0, [0, -1]] == pytest.approx(1.0), "half of it lies before the seam"


def test_bands_lie_between_their_limits() -> None:
    layer = bands(GRID, [(0.25, 0.5), (0.75, 0.8)])
    assert layer.mean() == pytest.approx(0.3)
    assert layer[40].min() == 1.0 and layer[80].max() == 0.0


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0])
def test_stripes_repeat_and_cover_their_share(angle_deg: float) -> None:
    layer = stripes(GRID, 0.25, 0.1, angle_deg)
    # At an angle the map holds no whole number of periods.
    assert layer.mean() == pytest.approx(0.4, abs=0.01)
    if angle_deg == 0.0:
        np.testing.assert_allclose(layer[:, 32:], layer[:, :-32], atol=1e-9)


def test_stripes_fit_around_a_tube() -> None:
    layer = stripes(AROUND, 0.3, 0.15)
    starts = np.count_nonzero((layer[0] > 0.5) & (np.roll(layer[0], 1) <= 0.5))
    assert starts == 7
    assert layer.mean() == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("radius_m", [0.001, 0.004, 0.03])
def test_dots_have_the_area_of_circles(radius_m: float) -> None:
    centers = [(0.2, 0.2), (0.9013, 0.5), (1.7, 0.7771)]
    area_m2 = dots(GRID, centers, radius_m).mean() * AREA_M2
    assert area_m2 == pytest.approx(3 * np.pi * radius_m**2, rel=0.03)


def test_rivets_follow_their_lines_at_their_pitch() -> None:
    layer = rivet_rows(FINE, [0.5, 1.5], pitch_m=0.05, radius_m=0.005)
    assert layer.mean() * AREA_M2 == pytest.approx(2 * 20 * np.pi * 0.005**2, rel=0.03)
    column = layer[:, int(0.5 / FINE.texel_m[0]) - 3 : int(0.5 / FINE.texel_m[0]) + 3].sum(axis=1)
    spectrum = np.abs(np.fft.rfft(column - column.mean()))
    assert int(spectrum[:30].argmax()) == 20


def test_stitches_repeat_along_their_seam() -> None:
    layer = stitches(FINE, [1.0], pitch_m=0.04, size_m=(0.02, 0.01))
    # 25 stitches of a fiftieth of the height.
    assert layer.sum() * FINE.texel_m[0] * FINE.texel_m[1] == pytest.approx(25 * 0.02 * 0.01)
    assert layer[:, : int(0.9 / FINE.texel_m[0])].max() == 0.0


def test_streaks_run_down_from_their_starts_and_fade() -> None:
    layer = streaks(GRID, 3, [(0.5, 0.3), (1.5, 0.3)], length_m=0.2, width_m=0.05)
    assert layer[: int(0.28 / GRID.texel_m[1])].max() < 1e-6
    near, far = layer[40:46].max(axis=1).mean(), layer[110:116].max(axis=1).mean()
    assert near > 3 * far > 0
    one = streaks(GRID, 3, [(0.5, 0.3)], length_m=0.2, width_m=0.05)
    # A further streak leaves the others as they are.
    np.testing.assert_array_equal(layer[:, :90], one[:, :90])
    up = streaks(GRID, 3, [(0.5, 0.7)], length_m=0.2, width_m=0.05, upstream=True)
    assert up[int(0.72 / GRID.texel_m[1]) :].max() < 1e-6 < up[:80].max()


def test_panels_differ_and_keep_the_mean() -> None:
    tint = panel_tints(GRID, 3, [0.5, 1.0, 1.5], [0.5], spread=0.05)
    assert tint.mean() == pytest.approx(1.0)
    assert len(np.unique(tint)) == 8
    around = panel_tints(AROUND, 3, [0.5, 1.0, 1.5], [0.5], spread=0.05)
    np.testing.assert_array_equal(around[:, 0], around[:, -1])


def test_panels_around_a_wrapping_map_are_as_many_as_their_limits() -> None:
    count, wide = 8, AROUND.width_m
    tint = panel_tints(AROUND, 3, np.arange(count) * wide / count, [], spread=0.05)[0]
    middles = ((np.arange(count) + 0.5) * len(tint) / count).astype(int)
    assert len(np.unique(tint[middles])) == len(np.unique(tint)) == count


@pytest.mark.parametrize("seed", range(12))
def test_a_roundel_covers_its_disc_in_few_colours(seed: int) -> None:
    share, rgb = roundel(FINE, seed, (1.0, 0.5), 0.3)
    assert share.mean() * AREA_M2 == pytest.approx(np.pi * 0.3**2, rel=0.005)
    whole = rgb[share == 1.0]
    colors = np.unique(whole.round(6), axis=0)
    assert len(colors) >= 3
    # No bare concentric rings, which is how nations mark their aircraft.
    angles = np.linspace(0.0, 2 * np.pi, 73)[:-1]
    radii = np.linspace(0.05, 0.5, 10)[:, None] * 0.3
    rows = ((0.5 + radii * np.sin(angles)) / FINE.texel_m[1]).astype(int)
    columns = ((1.0 + radii * np.cos(angles)) / FINE.texel_m[0]).astype(int)
    assert rgb[rows, columns].std(axis=1).max() > 0.02


def test_seeds_give_different_emblems() -> None:
    emblems = {roundel(GRID, seed, (1.0, 0.5), 0.3)[1].round(3).tobytes() for seed in range(30)}
    assert len(emblems) == 30


def test_layers_depend_on_their_seed_alone() -> None:
    first = [
        fractal_noise(GRID, 1, 0.2),
        streaks(GRID, 2, [(1.0, 0.2)], 0.2, 0.05),
        roundel(GRID, 3, (1.0, 0.5), 0.3)[1],
    ]
    again = [
        roundel(GRID, 3, (1.0, 0.5), 0.3)[1],
        streaks(GRID, 2, [(1.0, 0.2)], 0.2, 0.05),
        fractal_noise(GRID, 1, 0.2),
    ]
    for one, other in zip(first, reversed(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first[0], fractal_noise(GRID, 2, 0.2))


def test_finished_paint_stays_within_what_surfaces_reflect() -> None:
    paint = shaded(even_paint(GRID, (0.3, 0.2, 0.1)), 1.0 + 0.2 * fractal_noise(GRID, 3, 0.3))
    paint = covered(paint, lines(GRID, [0.5], 0.02), (0.02, 0.02, 0.02))
    texels = finished(10.0 * paint)
    assert texels.dtype == np.float32 and texels.shape == (128, 256, 3)
    assert texels.min() >= np.float32(0.01) and texels.max() <= np.float32(0.95)
