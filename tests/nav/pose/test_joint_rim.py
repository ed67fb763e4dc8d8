"""The pose by the rim's edge, from drawn edge points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drogue_models.marker_layout import MarkerLayout, RimOutline, marker_layout
from drogue_models.presets import load_drogue
from geometry.circles import disc_outline, project_disc_centers
from geometry.se3 import RigidTransform, exp_rotation
from geometry.stereo import EYES, StereoRig, paper_rig
from nav.pose.joint_rim import EDGE_SHIFT_SD_PX, ROLL_SD_RAD, joint_rim, outline_points, rim_bound
from nav.pose.pose_method import NoFixReason, Observation, RimEdges, Solution
from tests.support.painted_pairs import make_pose

RIG = paper_rig()
RIM = RimOutline(0.33, 0.006, np.zeros((0, 2)))


def observation_of(edges: RimEdges | None, rim: RimOutline | None = RIM, rig: StereoRig = RIG) -> Observation:
    layout = MarkerLayout(np.zeros((0, 3)), 0.05, None, rim=rim)
    return Observation(rig, layout, np.zeros((2, 0, 2)), np.zeros((2, 0, 2, 2)), rim=edges)


def draw_edges(
    pose: RigidTransform,
    sigma_px: float = 0.1,
    noise: np.random.Generator | None = None,
    rim: RimOutline = RIM,
    count: int = 60,
) -> RimEdges:
    """Points of both eyes, with noise and with shifts from their priors where there is a generator."""
    angles = np.tile(2 * np.pi * (np.arange(count) + 0.3) / count, 2)
    eyes = np.repeat([0, 1], count)
    places, normals = outline_points(RIG, rim, pose, angles, np.stack([RIG.eye_offset_m(eye) for eye in EYES])[eyes])
    if noise is not None:
        shift = noise.normal(0, EDGE_SHIFT_SD_PX)
        double = 2 * angles
        off = shift @ [
            np.ones(len(angles)),
            eyes - 0.5,
            np.cos(angles),
            np.sin(angles),
            np.cos(double),
            np.sin(double),
        ] + noise.normal(0, sigma_px, len(angles))
        places = places + off[:, None] * normals
    return RimEdges(eyes, places, normals, np.full(len(angles), sigma_px), (1.0, 1.0), (0.9, 0.9))


def solve(edges: RimEdges, rim: RimOutline = RIM) -> Solution:
    answer = joint_rim(observation_of(edges, rim))
    assert isinstance(answer, Solution), answer
    return answer


def reason_of(edges: RimEdges | None, rim: RimOutline | None = RIM) -> str:
    answer = joint_rim(observation_of(edges, rim))
    assert isinstance(answer, NoFixReason)
    return answer.reason


@pytest.mark.parametrize("eye", EYES)
def test_the_outline_of_a_thin_rim_is_the_image_of_its_circle(eye: str) -> None:
    pose = make_pose(0.4, -0.2, 2.0, 14, -9, 30)
    angles = 2 * np.pi * np.arange(256) / 256
    thin = RimOutline(0.33, 1e-9, np.zeros((0, 2)))
    places, normals = outline_points(RIG, thin, pose, angles, RIG.eye_offset_m(eye))
    # The centre of the conic through the points is that of the disc's image in closed form.
    x, y = ((places - places.mean(axis=0)) / 100).T
    a, b, c, d, e = np.linalg.lstsq(np.stack([x * x, x * y, y * y, x, y], 1), np.ones(256), rcond=None)[0]
    center = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e]) * 100 + places.mean(axis=0)
    assert center == pytest.approx(project_disc_centers(RIG, pose, np.zeros((1, 3)), 0.33, eye)[0], abs=1e-6)
    # Normals are unit vectors outwards, across the chord between neighbours to second order.
    chords = np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)
    assert np.abs((chords * normals).sum(axis=1)).max() < 1e-2
    assert ((places - center) * normals).sum(axis=1).min() > 0


def test_the_outline_is_what_a_whole_tube_reaches() -> None:
    rim = RimOutline(0.3, 0.03, np.zeros((0, 2)))
    pose = make_pose(0.3, 0.1, 1.8, -15, 12, 0)
    places, normals = outline_points(RIG, rim, pose, np.linspace(0, 6, 9), np.zeros(3))
    around, along = np.meshgrid(np.linspace(0, 2 * np.pi, 1441), np.linspace(0, 2 * np.pi, 361))
    radius = 0.27 + 0.03 * np.cos(along)
    tube = np.stack([radius * np.cos(around), radius * np.sin(around), 0.03 + 0.03 * np.sin(along)], -1).reshape(-1, 3)
    image = RIG.project(pose.apply(tube), "left")
    # Radius over distance squared is 3e-4 of the tube's 36 px; the grid's steps leave 1e-3 px.
    assert (image @ normals.T).max(axis=0) == pytest.approx((places * normals).sum(axis=1), abs=0.02)


@pytest.mark.parametrize("angles_deg", [(8, -6), (-11, 3), (0.5, 12)])
@pytest.mark.parametrize("z_m", [2.5, 12.0])
def test_exact_points_give_the_pose_without_its_roll(z_m: float, angles_deg: tuple[float, float]) -> None:
    pose = make_pose(0.1 * z_m, -0.05 * z_m, z_m, *angles_deg, 77)
    found = solve(draw_edges(pose, 0.01)).left_from_drogue
    assert found.translation_m == pytest.approx(pose.translation_m, abs=1e-6 * z_m)
    assert found.rotation[:, 2] == pytest.approx(pose.rotation[:, 2], abs=1e-5)
    assert found.rotation[1, 0] == 0


@pytest.mark.parametrize(("z_m", "error_m", "sd_m"), [(1.7, 1.1e-3, 2e-5), (2.8, 7e-4, 8e-5), (4.7, 4e-4, 2.8e-4)])
def test_a_rim_that_is_drawn_flat_looks_farther_than_its_tube(z_m: float, error_m: float, sd_m: float) -> None:
    """The analytic engine draws it so; studies/acceptance/RESULTS.md has these figures."""
    rim, pose = marker_layout(load_drogue("red-8")).rim, make_pose(0.06, 0, z_m, 5.7, 2.9)
    assert rim is not None
    # Points 6 px apart, as the edge is measured.
    count = int(2 * np.pi * rim.radius_m * RIG.camera.fx_px / z_m / 6)
    edges = draw_edges(pose, 0.02, None, rim, count)
    # As many points of the flat circle, from where the edge's begin.
    begin = RigidTransform(exp_rotation(np.array([0, 0, 2 * np.pi * 0.3 / count])), np.zeros(3))
    circle_m = disc_outline(pose @ begin, [0, 0, rim.tube_radius_m], rim.radius_m, count)
    places = np.concatenate([RIG.project(circle_m, eye) for eye in EYES])
    solution = solve(replace(edges, points_px=places), rim)
    # To the last digit of the figures.
    assert solution.left_from_drogue.translation_m[2] - z_m == pytest.approx(error_m, abs=6e-5)
    assert np.sqrt(solution.covariance[2, 2]) == pytest.approx(sd_m, rel=0.15)


def test_the_roll_is_stated_as_open() -> None:
    solution = solve(draw_edges(make_pose(0.2, 0.1, 6.0, 9, -7, 40), 0.05))
    axis = solution.left_from_drogue.rotation[:, 2]
    assert solution.covariance is not None
    assert axis @ solution.covariance[3:, 3:] @ axis == pytest.approx(ROLL_SD_RAD**2, rel=1e-3)
    assert "roll" in solution.note
    assert not solution.used.any()


@pytest.mark.parametrize(("z_m", "sigma_px"), [(3.0, 0.1), (8.0, 0.1), (8.0, 0.3)])
def test_errors_are_those_of_the_stated_covariance(z_m: float, sigma_px: float) -> None:
    rng = np.random.default_rng([3, int(z_m), int(100 * sigma_px)])
    squares = []
    for _ in range(10):
        pose = make_pose(*rng.uniform(-0.1, 0.1, 2) * z_m, z_m, *rng.choice([-1, 1], 2) * rng.uniform(6, 12, 2), 0)
        solution = solve(draw_edges(pose, sigma_px, rng))
        found, covariance = solution.left_from_drogue, solution.covariance
        assert covariance is not None
        turn = np.cross(pose.rotation[:, 2], found.rotation[:, 2])
        error = np.concatenate([found.translation_m - pose.translation_m, turn])
        across = np.zeros((5, 6))
        across[:3, :3], across[3:, 3:] = np.eye(3), found.rotation[:, :2].T
        squares.append(across @ error @ np.linalg.solve(across @ covariance @ across.T, across @ error) / 5)
    # A mean of 50 chi-squares of one degree: 0.65 to 1.43 in 95 of 100; twice as far.
    assert 0.3 < np.mean(squares) < 1.9


@pytest.mark.parametrize("count", [30, 120])
def test_the_bound_of_a_facing_rim_in_closed_form(count: int) -> None:
    z_m, sigma_px = 8.0, 0.2
    focal_px, baseline_m = RIG.camera.fx_px, RIG.baseline_m
    pose = RigidTransform(np.eye(3), np.array([baseline_m / 2, 0.0, z_m]))
    bound = rim_bound(RIG, RIM, pose, sigma_px, count)
    known = np.diag(np.linalg.inv(bound))
    # Of the other coordinates known: each point tells the rim's place along its own normal, on average half of it along
    # an axis, in both eyes. An edge that is shifted by the angle's sine looks like a rim elsewhere.
    assert known[1] == pytest.approx((focal_px / z_m) ** 2 / (sigma_px**2 / count + EDGE_SHIFT_SD_PX[3] ** 2), rel=0.01)
    # The disparity tells the depth by the points' normals along the rows, and the size by all, with their shift.
    by_disparity = (focal_px * baseline_m / (2 * z_m**2)) ** 2 * count / sigma_px**2
    shared_px2 = sigma_px**2 / (2 * count) + EDGE_SHIFT_SD_PX[0] ** 2
    by_size = (focal_px * RIM.radius_m / z_m**2) ** 2 / shared_px2
    # The middle line of the tube is two percent smaller than the rim.
    assert known[2] == pytest.approx(by_disparity + by_size, rel=0.03)
    assert bound[5, 5] == pytest.approx(ROLL_SD_RAD**2, rel=1e-3)


def test_both_tilts_of_a_far_rim_are_modes_and_a_near_one_has_one() -> None:
    rng = np.random.default_rng(8)
    far = solve(draw_edges(make_pose(0.0, 0.0, 40.0, 5, 0, 0), 0.2, rng))
    first, second = (mode.left_from_drogue.rotation[:, 2] for mode in far.modes)
    # Mirrored at the line of sight, to the noise of a degree.
    assert first[:2] == pytest.approx(-second[:2], abs=np.radians(2))
    assert sum(mode.weight for mode in far.modes) == pytest.approx(1)
    near_pose = make_pose(0.0, 0.0, 2.0, 6, 0, 0)
    near = solve(draw_edges(near_pose, 0.05, rng))
    assert near.modes[0].weight > 0.999
    assert near.left_from_drogue.rotation[:, 2] == pytest.approx(near_pose.rotation[:, 2], abs=np.radians(1))


def test_points_of_something_else_do_not_move_the_pose() -> None:
    rng = np.random.default_rng(5)
    pose = make_pose(0.3, -0.2, 6.0, 10, 5, 0)
    edges = draw_edges(pose, 0.05, rng)
    clean = solve(edges).left_from_drogue
    spoilt = edges.points_px.copy()
    # A hose across the rim, and a probe before it.
    for part in (slice(3, 11), slice(70, 80)):
        spoilt[part] += rng.uniform(2, 5) * edges.normals[part]
    found = solve(replace(edges, points_px=spoilt))
    assert found.covariance is not None
    deviations = np.sqrt(np.diag(found.covariance)[:3])
    assert (np.abs(found.left_from_drogue.translation_m - clean.translation_m) < deviations).all()


def test_what_bulges_behind_the_rim_is_left_out() -> None:
    rim = RimOutline(0.33, 0.006, np.array([[0.33, 0.05]]))
    pose = make_pose(0.0, 0.0, 5.0, 0, 10, 0)
    edges = draw_edges(pose, 0.05)
    bulge = replace(pose, translation_m=pose.apply(np.array([0.0, 0.0, 0.05])))
    behind = draw_edges(bulge, rim=RimOutline(0.33, 1e-9, np.zeros((0, 2))))
    # The silhouette is the further one of both.
    beyond = ((behind.points_px - edges.points_px) * edges.normals).sum(axis=1).clip(0)
    shown = replace(edges, points_px=edges.points_px + beyond[:, None] * edges.normals)
    assert beyond.max() > 2
    good = solve(shown, rim).left_from_drogue
    assert np.abs(good.translation_m - pose.translation_m).max() < 2e-3
    assert np.degrees(np.arccos(good.rotation[:, 2] @ pose.rotation[:, 2])) < 0.2


def test_reasons_where_there_is_no_pose() -> None:
    pose = make_pose(0.1, 0.1, 5.0, 8, -5, 0)
    edges = draw_edges(pose)
    assert "not known" in reason_of(edges, None)
    assert "may not be its rim" in reason_of(edges, replace(RIM, is_known=False))
    assert "needs images" in reason_of(None)
    assert "right image shows the rim's edge on 41 %" in reason_of(replace(edges, seen_fraction=(0.9, 0.41)))
    assert "no dark silhouette in the left image" in reason_of(replace(edges, darkness=(0.6, 0.9)))
    # The inner edge of a face: a circle, but by its disparity it is not where the rim is.
    inner = draw_edges(pose, rim=RimOutline(0.325, 0.006, np.zeros((0, 2))))
    assert "2.1 px inside of the rim" in reason_of(inner)
    rng = np.random.default_rng(2)
    wild = edges.points_px + rng.normal(0, 1.5, (len(edges.points_px), 1)) * edges.normals
    assert "scatters" in reason_of(replace(edges, points_px=wild))


def test_presets_say_whether_their_outline_is_the_rim() -> None:
    known = {name: marker_layout(load_drogue(name)).rim for name in ("red-8", "basket-net", "basket-tube")}
    assert {name: rim is not None and rim.is_known for name, rim in known.items()} == {
        "red-8": True,
        "basket-net": True,
        "basket-tube": False,
    }
    net = known["basket-net"]
    assert net is not None
    assert net.bulges_m[:, 0].max() <= net.radius_m
