"""Criteria on images: their arithmetic on frames whose errors are known, and the recipes that they render."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from datasets_manifest.recipe.recipe import load_recipe
from droguekit.batch.recipe_plan import plan_recipe
from studies.acceptance.centroid_level.monte_carlo import STATIONS_M
from studies.acceptance.finished_results import is_navigated, mark_navigated
from studies.acceptance.rendered import image_tiers
from studies.acceptance.rendered.image_tiers import ImageScores, recipe_of
from studies.acceptance.rendered.scored_frames import BEST, CHAIN, FrameErrors, MarkerErrors, contrast_from_snr

PER_STATION = 30
CENTROID_JUDGES = (
    image_tiers.centroid_bound_rows,
    image_tiers.centroid_rows,
    lambda images: image_tiers.chain_rows(images, 1 / 4),
)


def frames(sigma_px: float, pose_scale: float, stream: int, outward_px: float = 0.0) -> dict[int, FrameErrors]:
    """Frames at all stations: normal centroid errors, and poses off by a millimetre times the scale along X."""
    rng = np.random.default_rng(stream)
    found = {}
    for index in range(PER_STATION * len(STATIONS_M)):
        markers = MarkerErrors(sigma_px * rng.normal(size=(16, 2)), np.full(16, outward_px), np.full(16, 0.01))
        pose = np.array([1e-3 * pose_scale, 0.0, 0.0, 0.1, -0.1])
        found[index] = FrameErrors(STATIONS_M[index % len(STATIONS_M)], pose, 1e-3 * pose_scale, markers, 0.0)
    return found


def light(name: str = "day", **changes: dict[int, FrameErrors]) -> ImageScores:
    scores = {BEST: frames(0.012, 0.1, 1), CHAIN: frames(0.06, 2.0, 2), **changes}
    return ImageScores(name, scores)  # type: ignore[arg-type]


def test_centroids_over_their_bound() -> None:
    rows = image_tiers.centroid_bound_rows(light())
    assert [row.n for row in rows] == [7 * PER_STATION * 32, 2 * PER_STATION * 32]
    # Root mean square of 1920 numbers and more: 1.6 %; four of these.
    assert [row.measured for row in rows] == pytest.approx([1.2, 1.2], rel=0.065)
    assert rows[1].met


def test_markers_without_light_do_not_count() -> None:
    dark = frames(0.012, 0.1, 1)
    one = next(iter(dark))
    bound = np.full(16, 0.01)
    bound[:3] = np.inf
    dark[one] = FrameErrors(1.7, None, 0.0, MarkerErrors(np.full((16, 2), 0.012), np.zeros(16), bound), 0.0)
    rows = image_tiers.centroid_bound_rows(light(**{BEST: dark}))
    assert rows[0].n == 7 * PER_STATION * 32 - 6


@pytest.mark.parametrize(("name", "number"), [("day", "2"), ("dusk", "3")])
def test_every_distance_counts_once_in_absolute_centroids(name: str, number: str) -> None:
    rows = [row for row in image_tiers.centroid_rows(light(name)) if "RMS" in row.quantity]
    assert [row.bar for row in rows] == [number] * 3
    assert sum(row.n for row in rows) == PER_STATION * len(STATIONS_M) * 32


def test_a_bias_towards_the_outside_is_found_whatever_its_sign() -> None:
    for outward_px in (0.01, -0.01):
        biased = light(**{BEST: frames(0.012, 0.1, 1, outward_px)})
        rows = [row for row in image_tiers.centroid_rows(biased) if "radial" in row.quantity]
        # A constant has no spread.
        assert [row.measured for row in rows] == pytest.approx([0.01, 0.01])
        assert not any(row.met for row in rows)


def test_our_centroids_against_the_chain() -> None:
    (row,) = image_tiers.chain_rows(light(), 1 / 4)
    # Two root mean squares of 5760 numbers: 1.3 % together; four of these.
    assert row.measured == pytest.approx(0.2, rel=0.055)
    assert row.met


def test_markers_of_a_pair_that_err_alike_widen_the_limits() -> None:
    rng = np.random.default_rng(4)
    alike = {
        i: replace(f, markers=replace(f.markers, offset_px=np.tile(0.012 * rng.normal(size=2), (16, 1))))
        for i, f in frames(0.012, 0.1, 1).items()
    }
    rows = [rows[0] for rows in (judge(light(**{BEST: alike})) for judge in CENTROID_JUDGES)]
    apart = [rows[0] for rows in (judge(light()) for judge in CENTROID_JUDGES)]
    for shared, own in zip(rows, apart, strict=True):
        reaches = [row.limit_high / row.measured - 1 for row in (shared, own) if row.limit_high and row.measured]
        # 16 markers that err as one know a root mean square 4 times less well; half of it allows for scatter.
        assert reaches[0] > 2 * reaches[1] > 0


def test_a_single_pair_shows_no_ratio_of_centroids() -> None:
    ours, theirs = ({0: f[8]} for f in (frames(0.012, 0.1, 1), frames(0.06, 2.0, 2)))
    row = image_tiers.chain_rows(light(**{BEST: ours, CHAIN: theirs}), 1 / 4)[0]
    assert not row.met and row.note.startswith("a single pair was measured")


def test_a_single_pair_meets_no_criterion_of_centroids() -> None:
    single = light(**{BEST: {0: frames(1e-6, 0.1, 1)[8]}})
    rows = [*image_tiers.centroid_bound_rows(single), *image_tiers.centroid_rows(single)]
    assert not any(row.met for row in rows)
    assert any(row.note.startswith("a single pair was measured") for row in rows)


def test_a_stack_that_fails_on_most_pairs_is_not_passed() -> None:
    none = MarkerErrors(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    lost = {
        i: f if i % 10 == 0 else FrameErrors(f.distance_m, None, 0.0, none, 1.0)
        for i, f in frames(0.012, 0.1, 1).items()
    }
    pairs, markers = image_tiers.missing_rows(light(**{BEST: lost}), 0.01)
    assert (pairs.measured, markers.measured) == (pytest.approx(0.9), pytest.approx(0.9))
    assert not pairs.met and not markers.met


def test_single_markers_without_a_centroid_count_as_parts_of_pairs() -> None:
    some = {i: replace(f, unmeasured_fraction=1 / 16 if i < 16 else 0.0) for i, f in frames(0.012, 0.1, 1).items()}
    pairs, markers = image_tiers.missing_rows(light(**{BEST: some}), 0.02)
    count = len(some)
    # Clopper and Pearson's limits of none and of one of so many pairs.
    assert pairs.limit_high == pytest.approx(1 - 0.05 ** (1 / count)) and pairs.met
    assert markers.measured == pytest.approx(1 / count)
    assert markers.limit_high == pytest.approx(stats.beta.ppf(0.95, 2, count - 1))


@pytest.mark.parametrize(("tier", "high"), [("a", 0.005), ("b", 0.01)])
def test_all_pairs_of_a_tier_can_show_that_few_are_lost(tier: str, high: float) -> None:
    count = load_recipe(recipe_of(tier, "day")).recipe.frames.count
    whole = dict(zip(range(count), itertools.cycle(frames(0.012, 0.1, 1).values()), strict=False))
    assert all(row.met and row.high == high for row in image_tiers.missing_rows(light(**{BEST: whole}), high))


def test_the_same_centroids_compare_nothing() -> None:
    same = frames(0.01, 1.0, 1)
    (row,) = image_tiers.chain_rows(light(**{BEST: same, CHAIN: same}), 1 / 4)
    assert row.measured is None
    assert not row.met


def test_absolute_poses_and_the_comparison_with_the_paper() -> None:
    position, pitch, _, far_pitch, _ = image_tiers.absolute_rows(light())
    assert (position.measured, position.n, position.met) == (pytest.approx(0.1), 5 * PER_STATION, True)
    assert pitch.measured == pytest.approx(0.1)
    # Of 150 poses the largest is below the 99th percentile with 22 %.
    assert pitch.limit_high is None and not pitch.met
    assert far_pitch.n == PER_STATION
    (ratio,) = image_tiers.paper_rows(light())
    assert ratio.measured == pytest.approx(0.05)
    assert ratio.met and "two-sided" in ratio.note


def test_pairs_without_a_pose_are_told() -> None:
    some = frames(0.012, 0.1, 1)
    some[0] = replace(some[0], pose=None)
    row = image_tiers.absolute_rows(light(**{BEST: some}))[0]
    assert row.note == f"1 of {5 * PER_STATION} pairs without a pose"


def test_goals_are_there_for_every_distance() -> None:
    rows = image_tiers.goal_rows(light())
    assert len(rows) == 15
    assert {row.bar for row in rows} == {"goal"}


@pytest.mark.parametrize("share", [0.05, 1.0])
@pytest.mark.parametrize("contrast_e", [50.0, 5000.0])
def test_contrast_follows_from_the_recorded_signal_to_noise(contrast_e: float, share: float) -> None:
    snr = contrast_e / np.sqrt(contrast_e / 2 + share * contrast_e + 4.8**2)
    assert contrast_from_snr(snr, share, 4.8) == pytest.approx(contrast_e)


@pytest.mark.parametrize("tier", ["a", "b"])
@pytest.mark.parametrize("light_name", ["day", "dusk"])
def test_the_recipes_hold_the_protocol(tier: str, light_name: str) -> None:
    recipe = load_recipe(recipe_of(tier, light_name)).recipe
    assert recipe.distance.stations_m == STATIONS_M
    assert recipe.frames.count == len(STATIONS_M) * {"a": 400, "b": 64}[tier]
    assert recipe.render.engine == {"a": "analytic", "b": "mitsuba"}[tier]
    assert recipe.seed == 1
    part = recipe.model_copy(update={"frames": recipe.frames.model_copy(update={"count": 36})})
    distances = plan_recipe(part).drawn.distances_m
    assert np.unique(distances.round(6), return_counts=True)[1].tolist() == [4] * len(STATIONS_M)


def test_estimates_count_as_made_only_from_the_same_dataset_and_methods(tmp_path: Path) -> None:
    estimates = tmp_path / "estimates.jsonl"
    assert not is_navigated(estimates, "x", ["joint"])
    estimates.write_text("{}\n", encoding="utf-8")
    mark_navigated(estimates, "x", ["joint"])
    assert is_navigated(estimates, "x", ["joint"])
    assert not is_navigated(estimates, "y", ["joint"])
    assert not is_navigated(estimates, "x", ["joint", "paper"])
    estimates.write_text("{}\n{}\n", encoding="utf-8")
    assert not is_navigated(estimates, "x", ["joint"])
