"""The compiled loops against numpy, and when they are compiled."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from nav.centroids import blurred_edges, centroid_uncertainty, outline_pixels
from nav.centroids.centroid_uncertainty import sector_sums, zone_sums
from nav.centroids.ellipses import Ellipses
from nav.centroids.marker_signal import MarkerSignal
from nav.centroids.outline_pixels import annulus_pixels, disc_pixels
from nav.numerics import least_squares_loops
from nav.pose import adjustment_loops


def float32(rng, *shape):
    return rng.normal(size=shape).astype(np.float32)


def test_sums_of_least_squares_are_those_of_numpy():
    rng = np.random.default_rng(1)
    jacobian, residuals, weights = float32(rng, 5, 7, 300), float32(rng, 5, 300), rng.random((5, 300), np.float32)
    normal, gradient = np.empty((5, 7, 7)), np.empty((5, 7))
    least_squares_loops.normal_equations(jacobian, residuals, weights, normal, gradient)
    exact = jacobian.astype(np.float64)
    # Single precision over 300 products of numbers around one.
    close = {"rtol": 1e-5, "atol": 1e-3}
    np.testing.assert_allclose(normal, np.einsum("npk,nk,nqk->npq", exact, weights, exact), **close)
    np.testing.assert_allclose(gradient, np.einsum("npk,nk,nk->np", exact, weights, residuals), **close)
    coupled, others = np.empty((5, 7, 2)), float32(rng, 5, 2, 300)
    least_squares_loops.couplings(jacobian, others, weights, coupled)
    np.testing.assert_allclose(coupled, np.einsum("npk,nk,nqk->npq", exact, weights, others), **close)
    np.testing.assert_allclose(
        least_squares_loops.weighted_squares(residuals, weights),
        (weights * residuals.astype(np.float64) ** 2).sum(axis=1),
        **close,
    )
    covariance = np.linalg.inv(normal)
    filled = np.empty_like(weights)
    least_squares_loops.leverages(jacobian, np.linalg.cholesky(covariance).astype(np.float32), weights, filled)
    np.testing.assert_allclose(filled, weights * np.einsum("npk,npq,nqk->nk", exact, covariance, exact), rtol=1e-4)
    # A fit swallows as many pixels' worth of noise as it has parameters.
    np.testing.assert_allclose(filled.sum(axis=1), 7, rtol=1e-4)


def test_damped_steps_solve_their_systems():
    rng = np.random.default_rng(2)
    arms = rng.normal(size=(6, 9, 9))
    matrices, gradients, dampings = arms @ arms.transpose(0, 2, 1) + np.eye(9), rng.normal(size=(6, 9)), rng.random(6)
    scales = rng.uniform(0.1, 3, (6, 9))
    steps = least_squares_loops.damped_steps(matrices, scales, gradients, dampings)
    # What is added to a scaled diagonal is the more in the matrix's own units, the smaller the scale is.
    damped = matrices + (dampings[:, None] / scales**2)[:, None] * np.eye(9)
    np.testing.assert_allclose(steps, np.linalg.solve(damped, gradients[..., None])[..., 0], rtol=1e-9)
    matrices[0] *= -1
    steps = least_squares_loops.damped_steps(matrices, scales, gradients, 0 * dampings)
    assert np.isnan(steps).any(axis=1).tolist() == [True] + 5 * [False]


def test_pixels_that_see_no_edge_get_no_picture_whatever_the_outline_is():
    x, y, ones = float32(np.random.default_rng(6), 3, 2, 50)
    pictures, inside = np.zeros((2, 3, 50), np.float32), np.full((2, 50), np.nan, np.float32)
    inside[1] = 1.0
    ellipses = np.array([5 * [np.nan], [0.0, 0.0, np.nan, 0.1, 0.0]], np.float32)
    blurred_edges.add_box_pictures(ellipses, x, y, np.ones_like(x), inside, ones, pictures)
    assert not pictures.any()


@pytest.mark.parametrize("count", [8, 16])
def test_sectors_are_those_of_the_arc_tangent(count):
    rng = np.random.default_rng(3)
    x, y, ones = float32(rng, 3, 4000), float32(rng, 3, 4000), np.ones((3, 4000), np.float32)
    turn = np.arctan2(y, x) / (2 * np.pi) * count
    sectors = np.floor(turn).astype(int) % count
    # Places within the polynomial's error of a limit may lie on either side.
    clear = np.abs(turn - np.rint(turn)) > 1e-5 * count
    residuals, weights = float32(rng, 3, 4000), (clear & (rng.random((3, 4000)) > 0.3)).astype(np.float32)
    sums = sector_sums(x, y, residuals, weights, count)
    for patch in range(3):
        for place, values in enumerate((ones, residuals, residuals**2)):
            expected = np.bincount(sectors[patch], (weights * values)[patch].astype(np.float64), count)
            np.testing.assert_allclose(sums[patch, :, place], expected, rtol=1e-6, atol=1e-6)
    axes = np.array([[0, 1, 0, -1, 0, 1]], np.float32), np.array([[0, 0, 1, 0, -1, -1e-9]], np.float32)
    on_axes = sector_sums(*axes, np.ones((1, 6), np.float32), np.ones((1, 6), np.float32), 8)[0, :, 0]
    assert on_axes.tolist() == [2, 0, 1, 0, 1, 0, 1, 1]


def test_zones_are_open_intervals_of_present_pixels():
    inside = np.array([[0.0, 0.2, 0.5, 0.8, 1.0, 0.5]], np.float32)
    present = np.array([[1, 1, 1, 1, 1, 0]], np.float32)
    sums = zone_sums(
        np.arange(1, 7, dtype=np.float32)[None], present, inside, np.array([[0.2, 0.8], [0.7, 9]], np.float32)
    )
    assert sums[0].tolist() == [[15, 5], [3, 1], [9, 2]]


def outlines(rng, count, radius_px, side_px):
    shape = np.array([[1.0, 0.1], [0.1, 0.9]])
    centers = rng.uniform(0.45 * side_px, 0.55 * side_px, (count, 2))
    eyes = np.arange(count) % 2
    return Ellipses(eyes, centers, np.tile(radius_px * shape, (count, 1, 1)))


def inwards(outline, index, x, y):
    """Distances inwards of all pixels from one outline; for circles docs/explanation/centroids.md has it."""
    arms = np.linalg.solve(
        outline.shapes_px[index], np.stack([x, y]).reshape(2, -1) - outline.centers_px[index][:, None]
    )
    return (outline.radii_px[index] * (1 - np.hypot(*arms))).reshape(x.shape)


@pytest.mark.parametrize("radius_px", [6.0, 40.0])
@pytest.mark.parametrize("kind", ["disc", "annulus"])
def test_chosen_pixels_are_those_near_edges_and_few_of_the_others(kind, radius_px):
    rng = np.random.default_rng([4, int(radius_px)])
    side = int(3 * radius_px + 20)
    signals = [
        MarkerSignal(float32(rng, side, side), rng.random((side, side)) > 0.9, (0.0, 0.0), 1, True) for _ in "lr"
    ]
    outer = outlines(rng, 4, radius_px, side)
    inner = Ellipses(outer.eyes, outer.centers_px + 0.3, outer.shapes_px / 1.5)
    pixels = disc_pixels(signals, outer) if kind == "disc" else annulus_pixels(signals, outer, inner)
    y, x = np.mgrid[:side, :side].astype(np.float64)
    assert not pixels.truncated.any()
    for index in range(4):
        here = pixels.present[index] > 0
        columns = np.rint(pixels.x_px[index, here] + outer.centers_px[index, 0]).astype(int)
        rows = np.rint(pixels.y_px[index, here] + outer.centers_px[index, 1]).astype(int)
        taken = np.zeros((side, side), bool)
        taken[rows, columns] = True
        assert taken.sum() == here.sum()
        signal = signals[outer.eyes[index]]
        np.testing.assert_array_equal(pixels.values[index, here], signal.values[rows, columns])
        np.testing.assert_array_equal(pixels.clipped[index, here], signal.clipped[rows, columns])
        assert not pixels.values[index, ~here].any() and not pixels.clipped[index, ~here].any()
        to_outer, to_inner = inwards(outer, index, x, y), inwards(inner, index, x, y)
        at_edge = np.abs(to_outer) < 2.499
        within = to_outer > 2.501
        if kind == "annulus":
            at_edge |= np.abs(to_inner) < 2.499
            within &= to_inner < -2.501
            assert not (taken & (to_inner > 2.501)).any()
        assert taken[at_edge].all()
        assert not taken[to_outer < -2.501].any()
        if kind == "disc" and radius_px < 24:
            assert taken[within].all()
        else:
            step = np.flatnonzero((taken & within).any(axis=0))
            assert set(np.diff(step)) <= {4}
            assert (taken & within).sum() <= within.sum() / 16 + 4 * radius_px / 4


def test_an_outline_over_the_edge_of_the_image_is_cut():
    rng = np.random.default_rng(5)
    signals = [MarkerSignal(float32(rng, 60, 60), np.zeros((60, 60), bool), (0.0, 0.0), 1, True) for _ in "lr"]
    centers = np.array([[30.0, 30.0], [9.0, 30.0], [30.0, 51.0], [13.6, 30.0]])
    discs = Ellipses(np.array([0, 1, 0, 1]), centers, np.tile(10.0 * np.eye(2), (4, 1, 1)))
    # 10 px and 2.5 px beyond them.
    assert disc_pixels(signals, discs).truncated.tolist() == [False, True, True, False]


def test_what_is_fitted_before_pairs_come_leaves_next_to_nothing_to_compile():
    code = """
from datasets_manifest.recipe.recipe import load_recipe
from nav.centroids import blurred_edges, centroid_uncertainty, outline_pixels
from nav.numerics import least_squares_loops
from nav.realtime.warm_up import warm_up_jit
from nav.navigator import Navigator
from nav.pose import adjustment_loops
from render.engine import load_engine
from render.camera.sensor import expose
from scenes.sampler import sample_frame

def compiled():
    loops = (adjustment_loops, blurred_edges, centroid_uncertainty, least_squares_loops, outline_pixels)
    return {(name, kind) for room in loops for name, loop in vars(room).items()
            for kind in map(str, getattr(loop, "signatures", ()))}

warm_up_jit()
before = compiled()
recipe = load_recipe("pose-tier-a").recipe
for index in (1, 4):
    frame = sample_frame(recipe, index)
    images = expose(frame, load_engine("analytic").render(frame, recipe.render))
    (estimate,) = Navigator(recipe.rig, recipe.drogue).estimate(index, images, ["joint-hub"])
    assert estimate.status == "fix"
print(len(before), *sorted({name for name, _ in compiled() - before}))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    count, *later = done.stdout.split()
    assert int(count) > 10
    # Images may be of another kind of numbers than what was fitted.
    assert set(later) <= {"take_cells"}


@pytest.mark.parametrize(
    "loops",
    [adjustment_loops, blurred_edges, centroid_uncertainty, least_squares_loops, outline_pixels],
)
def test_loops_can_be_cached_beside_their_file_or_at_home(loops):
    found = [loop for loop in vars(loops).values() if hasattr(loop, "signatures")]
    assert found and all(loop.stats.cache_path for loop in found)
