"""Matching simulated centres: rolls, missing markers, false blobs, rings that do not belong together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from drogue_models.marker_layout import MarkerLayout, marker_layout
from drogue_models.presets import PRESETS
from geometry.circles import disc_area_px2, project_disc_centers
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform
from geometry.stereo import EYES, Eye, StereoRig, paper_rig
from nav.centroids.binary_centroids import BinaryCentroids, quantisation_variance_px2
from nav.matching.marker_channel import Blobs
from nav.matching.ring_matching import least_markers, match_ring, symmetry_permutations
from nav.pair_navigator import correspond
from nav.pose.pose_method import NoFixReason, Observation
from tests.support.painted_pairs import make_pose

RIG = paper_rig()


def centroids(
    layout: MarkerLayout,
    place: RigidTransform,
    eye: Eye,
    rng: np.random.Generator,
    hidden: Sequence[int] = (),
    false_discs: Sequence[tuple[float, ...]] = (),
) -> BinaryCentroids:
    """Centres of the visible markers and the hub with their noise in a random order; false ones as (dx, dy, factor)."""
    kept = [i for i in range(layout.count) if i not in hidden]
    centers = project_disc_centers(RIG, place, layout.centers_m, layout.radius_m, eye)[kept]
    areas = np.array([disc_area_px2(RIG, place, layout.centers_m[i], layout.radius_m, eye) for i in kept])
    hub = project_disc_centers(RIG, place, layout.hub_center_m[None], [layout.hub_outer_radius_m], eye)
    hub_area = disc_area_px2(RIG, place, layout.hub_center_m, layout.hub_outer_radius_m, eye)
    middle = RIG.project(place.translation_m, eye)
    radius_px = RIG.camera.fx_px * 0.27 / place.translation_m[2]
    extra = np.array([middle + radius_px * np.array(disc[:2]) for disc in false_discs]).reshape(-1, 2)
    extra_areas = [areas.mean() * disc[2] for disc in false_discs]
    centers, areas = np.concatenate([centers, hub, extra]), np.concatenate([areas, [hub_area], extra_areas])
    variance = quantisation_variance_px2(np.sqrt(areas / np.pi))
    centers = centers + np.sqrt(variance)[:, None] * rng.standard_normal(centers.shape)
    order = rng.permutation(len(areas))
    return BinaryCentroids(Blobs(centers[order], areas[order]), variance[order, None, None] * np.eye(2))


def worst_match_px(observation: Observation, layout: MarkerLayout, place: RigidTransform) -> float:
    """Largest distance of a matched centre from where its marker is, over the best turn of the layout."""
    worst = []
    for permutation in symmetry_permutations(layout):
        truth = np.stack(
            [project_disc_centers(RIG, place, layout.centers_m[permutation], layout.radius_m, eye) for eye in EYES]
        )
        worst.append(np.nanmax(np.abs(observation.pixels_px - truth)))
    return float(min(worst))


def matched(
    layout: MarkerLayout,
    place: RigidTransform,
    rng: np.random.Generator,
    hidden: Sequence[int] = (),
    false_discs: Sequence[tuple[float, ...]] = (),
) -> Observation:
    left, right = (centroids(layout, place, eye, rng, hidden, false_discs) for eye in EYES)
    return correspond(left, right, RIG, layout)


@pytest.mark.parametrize("count", [5, 7, 8])
@pytest.mark.parametrize("z_m", [1.7, 5, 40])
def test_all_markers_at_every_roll(count: int, z_m: float) -> None:
    layout = marker_layout(PRESETS[f"red-{count}"])
    rng = np.random.default_rng([count, int(z_m)])
    for roll_deg in np.linspace(-180, 180, 17):
        place = make_pose(0.06, 0, z_m, *rng.uniform(-10, 10, 2), roll_deg)
        observation = matched(layout, place, rng)
        assert not isinstance(observation, NoFixReason), observation.reason
        assert observation.paired.sum() == count
        # Five standard deviations of the noisiest centre, 0.092 px at 40 m.
        assert worst_match_px(observation, layout, place) < 0.46


@pytest.mark.parametrize("z_m", [1.7, 5, 40])
@pytest.mark.parametrize("blind", EYES)
def test_four_markers_are_enough_where_the_other_image_says_where_they_are(blind: str, z_m: float) -> None:
    layout = marker_layout(PRESETS["red-8"])
    rng = np.random.default_rng([EYES.index(blind), int(z_m)])
    for roll_deg in (-170, -25, 0, 40):
        place = make_pose(0.06, 0, z_m, *rng.uniform(-15, 15, 2), roll_deg)
        hidden = {eye: (0, 1, 2, 3) if eye == blind else (1, 2) for eye in EYES}
        # A disc where no marker is, as large as one, changes nothing.
        shown = [centroids(layout, place, eye, rng, hidden[eye], [(0.5, 0.2, 1.0)]) for eye in EYES]
        assert match_ring(shown[EYES.index(blind)].blobs, layout) is None
        observation = correspond(*shown, RIG, layout)
        assert not isinstance(observation, NoFixReason), observation.reason
        assert sorted(observation.seen.sum(axis=1)) == [4, 6] and observation.paired.sum() == 4
        assert worst_match_px(observation, layout, place) < 0.46


def test_four_discs_elsewhere_are_no_ring_beside_the_other_images() -> None:
    layout = marker_layout(PRESETS["red-8"])
    rng = np.random.default_rng(1)
    left = centroids(layout, make_pose(0.06, 0, 5, 5, -5, 0), "left", rng)
    # By three radii of a marker further to the side than the ring in the left image puts it.
    off_m = 3 * layout.radius_m
    right = centroids(layout, make_pose(0.06 + off_m, 0, 5, 5, -5, 0), "right", rng, hidden=(0, 1, 2, 3))
    observation = correspond(left, right, RIG, layout)
    assert not isinstance(observation, NoFixReason)
    assert observation.seen.sum(axis=1).tolist() == [8, 0]


@pytest.mark.parametrize("count", [5, 7, 8])
@pytest.mark.parametrize("missing", [0, 2, 4])
def test_one_missing_marker_leaves_a_gap(count: int, missing: int) -> None:
    layout = marker_layout(PRESETS[f"red-{count}"])
    rng = np.random.default_rng(missing)
    place = make_pose(0.06, 0, 10, 8, -6, 10)
    observation = matched(layout, place, rng, hidden=(missing,))
    assert not isinstance(observation, NoFixReason), observation.reason
    assert observation.paired.sum() == count - 1
    assert worst_match_px(observation, layout, place) < 0.46


@pytest.mark.parametrize("count", [5, 7, 8])
def test_false_blobs_are_left_out(count: int) -> None:
    layout = marker_layout(PRESETS[f"red-{count}"])
    # Beside the ring, inside it, and of the wrong size near a marker.
    false_discs = [(1.3, 0.4, 1.0), (-0.5, 0.3, 1.0), (0.1, -1.4, 1.2), (0.95, -0.6, 0.1), (-1.2, -1.2, 3.0)]
    for seed in range(8):
        rng = np.random.default_rng(seed)
        place = make_pose(0.06, 0, rng.uniform(2, 30), *rng.uniform(-10, 10, 2), rng.uniform(-180, 180))
        observation = matched(layout, place, rng, false_discs=false_discs)
        assert not isinstance(observation, NoFixReason), observation.reason
        assert observation.paired.sum() == count
        assert worst_match_px(observation, layout, place) < 0.46


def test_a_marker_may_be_missing_in_one_eye_only() -> None:
    layout = marker_layout(PRESETS["red-8"])
    rng = np.random.default_rng(3)
    place = make_pose(0.06, 0, 5, 7, 7, 12)
    observation = correspond(
        centroids(layout, place, "left", rng), centroids(layout, place, "right", rng, hidden=(2,)), RIG, layout
    )
    assert not isinstance(observation, NoFixReason)
    assert observation.seen.sum(axis=1).tolist() == [8, 7]
    assert worst_match_px(observation, layout, place) < 0.46


def test_markers_that_are_cut_or_off_their_row_are_dropped() -> None:
    layout = marker_layout(PRESETS["red-8"])
    rng = np.random.default_rng(4)
    place = make_pose(0.06, 0, 5, 7, 7, 12)
    left, right = (centroids(layout, place, eye, rng) for eye in EYES)
    # Area order is random: take two regions that are markers, told from the hub by their area.
    first, second = np.flatnonzero(left.blobs.areas_px2 < 1.5 * np.median(left.blobs.areas_px2))[:2]
    left.blobs.areas_px2[first] *= 0.55
    left.blobs.centers_px[second, 1] += 3
    observation = correspond(left, right, RIG, layout)
    assert not isinstance(observation, NoFixReason)
    assert observation.seen.sum(axis=1).tolist() == [6, 7]


def test_rings_of_two_drogues_are_not_matched() -> None:
    layout = marker_layout(PRESETS["red-8"])
    rng = np.random.default_rng(5)
    left = centroids(layout, make_pose(0.06, 0, 5), "left", rng)
    right = centroids(layout, make_pose(0.9, 0.3, 5), "right", rng)
    answer = correspond(left, right, RIG, layout)
    assert isinstance(answer, NoFixReason)
    assert "do not belong together" in answer.reason


@pytest.mark.parametrize("eye", EYES)
def test_too_few_regions_in_one_eye_leave_the_other(eye: Eye) -> None:
    layout = marker_layout(PRESETS["red-8"])
    rng = np.random.default_rng(6)
    place = make_pose(0.06, 0, 5)
    parts = {other: centroids(layout, place, other, rng) for other in EYES}
    parts[eye] = centroids(layout, place, eye, rng, hidden=range(5))
    observation = correspond(parts["left"], parts["right"], RIG, layout)
    assert not isinstance(observation, NoFixReason), observation.reason
    assert observation.seen.sum(axis=1).tolist() == [0 if other == eye else 8 for other in EYES]
    # Six deviations of centroids of black and white pixels with a radius of 21 px.
    assert worst_match_px(observation, layout, place) < 6 * 0.033


def test_too_few_regions_in_both_eyes() -> None:
    layout = marker_layout(PRESETS["red-8"])
    place, rng = make_pose(0.06, 0, 5), np.random.default_rng(8)
    left, right = (centroids(layout, place, eye, rng, hidden=range(4)) for eye in EYES)
    answer = correspond(left, right, RIG, layout)
    assert isinstance(answer, NoFixReason)
    assert "regions of the left image" in answer.reason
    assert "regions of the right image" in answer.reason


def test_an_uneven_layout_keeps_its_own_names() -> None:
    centers = marker_layout(PRESETS["red-8"]).centers_m[[0, 1, 2, 4, 5, 7]]
    layout = MarkerLayout(centers, 0.05, np.array([0, 0, 0.25]), 0.05, 0.075)
    assert layout.symmetry_order == 1
    rng = np.random.default_rng(7)
    for roll_deg in (-150, -20, 0, 100):
        place = make_pose(0.06, 0, 8, 5, -8, roll_deg)
        observation = matched(layout, place, rng)
        assert not isinstance(observation, NoFixReason), observation.reason
        assert worst_match_px(observation, layout, place) < 0.46


@pytest.mark.parametrize(("count", "least"), [(3, 3), (4, 4), (5, 4), (7, 5), (8, 5), (12, 8)])
def test_least_markers(count: int, least: int) -> None:
    angles = 2 * np.pi * np.arange(count) / count
    centers = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    assert least_markers(MarkerLayout(centers, 0.05, None)) == least


def test_permutations_of_an_even_ring_are_its_turns() -> None:
    permutations = symmetry_permutations(marker_layout(PRESETS["red-5"]))
    assert sorted(map(tuple, permutations)) == sorted(tuple(np.roll(np.arange(5), shift)) for shift in range(5))


def test_a_mirrored_ring_is_no_ring() -> None:
    # Gaps of 1, 2, 1, 1 and 3 places have a handedness: no turn makes them 1, 1, 2, 1 and 3.
    centers = marker_layout(PRESETS["red-8"]).centers_m[[0, 1, 3, 4, 5]]
    layout = MarkerLayout(centers, 0.05, None)
    areas_px2 = np.full(5, np.pi * 20**2)
    good = match_ring(Blobs(centers[:, :2] * 400 + 600, areas_px2), layout)
    assert good is not None
    assert good.count == 5
    mirrored = match_ring(Blobs(centers[:, :2] * (-400, 400) + 600, areas_px2), layout)
    assert mirrored is None or mirrored.count < 5


def test_markers_that_the_edge_of_a_picture_cuts_are_told_by_those_that_it_leaves_whole() -> None:
    layout, rng = marker_layout(PRESETS["red-8"]), np.random.default_rng(9)
    told = {"whole": 0, "cut": 0}
    for _ in range(200):
        place = make_pose(0, 0, rng.uniform(1.7, 6), *rng.uniform(-10, 10, 2), rng.uniform(-180, 180))
        centers = project_disc_centers(RIG, place, layout.centers_m, layout.radius_m, "left")
        areas = np.array([disc_area_px2(RIG, place, center, layout.radius_m, "left") for center in layout.centers_m])
        radii = np.sqrt(areas / np.pi)[:, None]
        # A picture's corner somewhere in the ring's upper left, its other sides far away.
        moved = centers - (centers.min(axis=0) + rng.uniform(-1.5, 1.5, 2) * radii.max())
        size = (2000, 2000)
        # A disc at 10 degrees is narrower than its mean radius by 1 %, and nobody sees less than half a pixel.
        whole = (moved > 1.02 * radii + 0.5).all(axis=1)
        if whole.sum() < least_markers(layout):
            continue
        match = match_ring(Blobs(moved[whole], areas[whole]), layout)
        assert match is not None and match.count == whole.sum()
        cut = match.cut(layout, size)
        assert not cut[match.blob_of_marker >= 0].any()
        # Perspective moves markers off the map by up to a third of their radius.
        clearly = (moved < 0.6 * radii).any(axis=1)
        assert cut.sum() >= clearly.sum()
        told["whole"] += int(whole.sum())
        told["cut"] += int(clearly.sum())
    # Both happen.
    assert min(told.values()) > 100


@pytest.mark.parametrize("baseline_m", [0.12, 1.0])
def test_rings_at_the_sides_of_wide_images_belong_together(baseline_m: float) -> None:
    """There a tilted ring is drawn out, and its size says more than its distance."""
    layout, rng = marker_layout(PRESETS["red-8"]), np.random.default_rng(4)
    rig = StereoRig(PinholeCamera(1280, 960, 600.0, 600.0, 639.5, 479.5), baseline_m)
    size_px, matched_rings, sizes_off = np.array([1280, 960]), 0, []
    for _ in range(150):
        z_m = rng.uniform(3 * baseline_m + 1, 8)
        x_m, y_m = rng.uniform(-1, 1, 2) * size_px / 2 / rig.camera.fx_px * z_m
        place = make_pose(x_m + baseline_m / 2, y_m, z_m, *rng.uniform(-20, 20, 2), rng.uniform(-22, 22))
        radius_px = rig.camera.fx_px * layout.radius_m / z_m
        centers = [rig.project(place.apply(layout.centers_m), eye) for eye in EYES]
        if any((np.minimum(each, size_px - each) < radius_px).any() for each in centers):
            continue
        areas, cov = (
            np.full(layout.count, np.pi * radius_px**2),
            np.broadcast_to(0.01 * np.eye(2), (layout.count, 2, 2)),
        )
        rings = [match_ring(Blobs(each, areas), layout) for each in centers]
        if any(ring is None or ring.count < layout.count for ring in rings):
            continue
        matched_rings += 1
        sizes_off.append(rings[0].scale_px_per_m * z_m / rig.camera.fx_px)
        orders = [rng.permutation(layout.count) for _ in EYES]
        seen = [BinaryCentroids(Blobs(each[order], areas), cov) for each, order in zip(centers, orders, strict=True)]
        observation = correspond(*seen, rig, layout)
        assert not isinstance(observation, NoFixReason), observation.reason
        found = [
            np.argmin(np.linalg.norm(each[:, None] - pixels, axis=2), axis=0)
            for each, pixels in zip(centers, observation.pixels_px, strict=True)
        ]
        np.testing.assert_array_equal(found[0], found[1])
    assert matched_rings > 50 and max(sizes_off) > 1.2


def partly_beside(
    rng: np.random.Generator, layout: MarkerLayout, whole_left: int, whole_right: int
) -> tuple[RigidTransform, dict[str, np.ndarray]]:
    """A place near by where the edges of the images leave so many markers whole."""
    size_px = np.array([RIG.camera.width_px, RIG.camera.height_px])
    while True:
        x_m, y_m = rng.uniform(-0.5, 0.6), rng.choice([-1, 1]) * rng.uniform(0.2, 0.6)
        place = make_pose(x_m, y_m, rng.uniform(1.5, 1.8), *rng.uniform(-10, 10, 2), rng.uniform(-180, 180))
        cut, unclear = [], False
        for eye in EYES:
            centers = project_disc_centers(RIG, place, layout.centers_m, layout.radius_m, eye)
            areas = [disc_area_px2(RIG, place, center, layout.radius_m, eye) for center in layout.centers_m]
            # A disc tilted by 30 degrees reaches further than its mean radius by 7 %.
            reach = 1.1 * np.sqrt(np.array(areas) / np.pi)[:, None] + 1
            depth = np.minimum(centers, size_px - centers).min(axis=1) / reach[:, 0]
            cut.append(np.flatnonzero(depth < 1))
            unclear |= bool(((depth > 0.5) & (depth < 1)).any())
        if not unclear and [layout.count - len(one) for one in cut] == [whole_left, whole_right]:
            return place, dict(zip(EYES, cut, strict=True))


@pytest.mark.parametrize("whole", [(4, 4), (4, 3), (3, 4)])
def test_what_the_edges_of_both_images_leave_of_a_ring_is_enough(whole: tuple[int, int]) -> None:
    layout, rng = marker_layout(PRESETS["red-8"]), np.random.default_rng(whole)
    for _ in range(40):
        place, cut = partly_beside(rng, layout, *whole)
        shown = [centroids(layout, place, eye, rng, cut[eye]) for eye in EYES]
        assert all(match_ring(one.blobs, layout) is None for one in shown)
        observation = correspond(*shown, RIG, layout)
        assert not isinstance(observation, NoFixReason), observation.reason
        assert observation.seen.sum(axis=1).tolist() == list(whole)
        # Six deviations of centroids of black and white pixels with a radius of 55 px.
        assert worst_match_px(observation, layout, place) < 6 * 0.0203


def test_four_markers_are_not_enough_where_the_images_show_the_places_of_the_others() -> None:
    layout, rng = marker_layout(PRESETS["red-8"]), np.random.default_rng(12)
    place = make_pose(0.06, 0, 1.8)
    shown = [centroids(layout, place, eye, rng, hidden=range(4)) for eye in EYES]
    assert isinstance(correspond(*shown, RIG, layout), NoFixReason)


def test_parts_of_a_ring_at_other_distances_do_not_belong_together() -> None:
    layout, rng = marker_layout(PRESETS["red-8"]), np.random.default_rng(13)
    for _ in range(20):
        place, cut = partly_beside(rng, layout, 4, 4)
        left = centroids(layout, place, "left", rng, cut["left"])
        # As far off as a ring a fifth nearer.
        x_m, y_m, z_m = place.translation_m
        off = RigidTransform(place.rotation, (x_m + 0.2 * RIG.baseline_m, y_m, z_m))
        answer = correspond(left, centroids(layout, off, "right", rng, cut["right"]), RIG, layout)
        assert isinstance(answer, NoFixReason)


def test_three_markers_and_the_hub_are_no_four_markers() -> None:
    layout, rng = marker_layout(PRESETS["red-8"]), np.random.default_rng(14)
    for _ in range(60):
        place, cut = partly_beside(rng, layout, 3, 3)
        shown = [centroids(layout, place, eye, rng, cut[eye]) for eye in EYES]
        assert isinstance(correspond(*shown, RIG, layout), NoFixReason)
