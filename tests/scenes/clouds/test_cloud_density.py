"""The density of clouds: lumps, edges, and what is left out of them, against closed forms and independent sums."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from scenes.clouds.cloud_density import HIGHEST_LUMP, layer_excess, lump_at
from scenes.clouds.cloud_layers import cloud_shape, render_cloud_layer
from scenes.clouds.cloud_textures import lump_volume
from scenes.sky.photometry import luminance
from tests.scenes.clouds.test_clouds import SIDE_LIGHT, layer, looking


def test_no_lump_floats_far_from_its_cloud() -> None:
    """An octave that adds at most l = 0.8 of its amount a on a surface, where creases stand out, makes cloud of nothing
    that is deeper than l / (1 + l / 0.3) a < 0.22 a outside; each octave is 0.6 times the one before."""
    shape = cloud_shape(layer(kind="cumulus", thickness_m=800.0))
    rng = np.random.default_rng(7)
    places_m = np.stack([*rng.uniform(0.0, 12_000.0, (2, 40_000)), rng.uniform(0.0, 800.0, 40_000)], axis=-1)
    larger_m = layer_excess(shape.numbers, shape.body, shape.lumps, places_m, 1e6)
    detailed_m = layer_excess(shape.numbers, shape.body, shape.lumps, places_m, 1.0)
    most_m = 0.22 * shape.numbers[8] / (1.0 - 0.6)
    outside = larger_m < -most_m
    assert 0.3 < outside.mean() < 0.99 and (detailed_m[outside] < 0.0).all()
    # Nearer there are some.
    assert (detailed_m[(larger_m < 0.0) & ~outside] > 0.0).mean() > 0.02


@pytest.mark.parametrize("kind", ["stratus", "altocumulus"])
def test_lumps_that_cannot_change_a_side_are_left_out_rightly(kind: str) -> None:
    """A place is inside just where the larger shape with every octave is; the march leaves out most octaves."""
    shape = cloud_shape(layer(kind=kind, thickness_m=400.0, feature_size_m=900.0))
    thick_m, fine_m, amount_m, shift = (float(shape.numbers[at]) for at in (2, 7, 8, 10))
    rng = np.random.default_rng(3)
    places_m = np.stack([*rng.uniform(0.0, 9000.0, (2, 30_000)), rng.uniform(0.0, thick_m, 30_000)], axis=-1)
    quick_m = layer_excess(shape.numbers, shape.body, shape.lumps, places_m, 2.0)
    excess_m = layer_excess(shape.numbers, shape.body, shape.lumps, places_m, 1e6)
    larger_m = excess_m.copy()
    if kind == "stratus":
        amount_m = amount_m * np.clip(0.25 + 1.6 * places_m[:, 2] / thick_m, 0.25, 1.0)
    at, seen = places_m / fine_m + [1.7 * shift, 0.0, 0.0], 0.7 * fine_m / 2.0
    while seen > 1.0:
        lumps = np.array([lump_at(shape.lumps, *place) for place in at])
        outside = (lumps > 0.0) & (excess_m < 0.0)
        octave_m = amount_m * min(seen - 1.0, 1.0)
        lumps[outside] *= np.maximum(1.0 + excess_m / (0.3 * octave_m), 0.0)[outside]
        excess_m, amount_m, seen = excess_m + octave_m * lumps, 0.6 * amount_m, seen / 2.13
        x, y, z = at.T
        at = 2.13 * np.stack([0.8 * y + 0.6 * z, 0.8 * z - 0.6 * y, x], axis=-1) + [0.31, 0.0, 0.0]
    # The octaves change many sides.
    assert ((larger_m > 0.0) != (excess_m > 0.0)).mean() > 0.02
    np.testing.assert_array_equal(quick_m > 0.0, excess_m > 0.0)


def test_sides_of_heaps_are_half_transparent() -> None:
    """Dry air tears them; edges that are as hard all around as on top leave one in eighteen pixels to the sky."""
    shares = []
    for kind, seed in product(("cumulus", "congestus"), range(1, 5)):
        heaps = layer(kind=kind, height_above_camera_m=700.0, feature_size_m=1200.0, thickness_m=700.0,
                      cover_fraction=0.35, texture_seed=seed)  # fmt: skip
        opacity = render_cloud_layer(heaps, looking(320, 240, 400.0, 25.0), SIDE_LIGHT).opacity
        shares.append(np.mean((opacity > 0.1) & (opacity < 0.9)) / np.mean(opacity > 0.1))
    assert 0.1 < np.mean(shares) < 0.25


def test_cumulus_is_narrower_at_its_base_than_above() -> None:
    shape = cloud_shape(layer(kind="cumulus", thickness_m=800.0, cover_fraction=0.4))
    shares = []
    for height_m in (20.0, 240.0, 640.0):
        east_m, north_m = np.meshgrid(np.arange(0.0, 12_000.0, 60.0), np.arange(0.0, 12_000.0, 60.0))
        places_m = np.stack([east_m.ravel(), north_m.ravel(), np.full(east_m.size, height_m)], axis=-1)
        shares.append((layer_excess(shape.numbers, shape.body, shape.lumps, places_m, 1e6) > 0.0).mean())
    assert shares[1] > 1.2 * shares[0] and shares[1] > 1.2 * shares[2]


@pytest.mark.parametrize("kind", ["cumulus", "stratus", "altocumulus"])
def test_clouds_are_rough_at_all_scales(kind: str) -> None:
    """The power of their light falls over a decade as that of photographs does, with the wave number to the -3.5."""
    slopes = []
    for seed in (1, 2):
        cloud = layer(kind=kind, height_above_camera_m=-1000.0, cover_fraction=0.9, texture_seed=seed)
        seen = render_cloud_layer(cloud, looking(128, 128, 400.0, -40.0), SIDE_LIGHT)
        window = np.outer(np.hanning(128), np.hanning(128))
        light = luminance(seen.radiance)
        power = np.abs(np.fft.fft2((light - light.mean()) * window)) ** 2
        radius = np.hypot(*np.meshgrid(np.fft.fftfreq(128), np.fft.fftfreq(128))) * 128
        rings = np.array([power[(radius >= low) & (radius < 1.3 * low)].mean() for low in 1.3 ** np.arange(5, 14)])
        slopes.append(np.polyfit(np.log(1.3) * np.arange(len(rings)), np.log(rings), 1)[0])
    assert -4.3 < np.mean(slopes) < -2.0


def test_nothing_rises_above_the_highest_lump() -> None:
    """Rays leave out what cannot be cloud even if the highest lump were there."""
    assert 0.98 * HIGHEST_LUMP < lump_volume().max() <= HIGHEST_LUMP
