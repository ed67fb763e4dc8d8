"""Disparity and optical flow against labels, OpenCV, meshes and a finer z-buffer."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.calibration.calibration_files import opencv_stereo_matrices
from datasets_manifest.types.appearance import Obstacle
from datasets_manifest.types.environment import CloudLayer
from datasets_manifest.types.frame import FrameSpec
from drogue_models.marker_layout import marker_layout
from drogue_models.meshes import hose_mesh
from drogue_models.obstacles import ObstacleShape
from drogue_models.parts import FIRST_MARKER_ID, Part
from geometry.pinhole import PinholeCamera
from geometry.se3 import RigidTransform, exp_twist
from geometry.stereo import EYES, Eye, StereoRig
from labelgen.dense_matches import PixelMatches, SurfacePasses, flow_matches, stereo_matches
from render.analytic_engine.flat_drogue import EyeView, flat_drogue
from render.analytic_engine.ring_passes import pixel_passes
from scenes.sampler import sample_frame
from tests.support.drawn_pairs import draw_eye
from tests.support.recipe_builder import RIG_160_PX, RIG_320_PX, build_recipe, stations

OTHER: dict[Eye, Eye] = {"left": "right", "right": "left"}
DROGUE_MOVES = exp_twist([0.02, -0.03, -0.15, 0.02, -0.03, 0.01])
CAMERA_TURNS = exp_twist([0.0, 0.0, 0.0, 0.004, -0.006, 0.003])


def passes(frame: FrameSpec, eye: Eye) -> SurfacePasses:
    drawn = draw_eye(frame, eye)
    return SurfacePasses(drawn.part_id, drawn.depth_m, drawn.normal)


def moved(frame: FrameSpec, **changes: Any) -> FrameSpec:
    """The frame a moment later: the drogue has moved and turned, and the camera has turned."""
    assert frame.left_from_drogue is not None
    return frame.model_copy(
        update={
            "left_from_drogue": CAMERA_TURNS.inverse() @ frame.left_from_drogue @ DROGUE_MOVES,
            "world_from_left": frame.world_from_left @ CAMERA_TURNS,
            **changes,
        }
    )


@pytest.fixture(scope="module")
def frame() -> FrameSpec:
    """A drogue at 2.5 m."""
    return sample_frame(
        build_recipe(name="dense", seed=3, rig=RIG_160_PX, frames={"count": 1}, distance=stations(2.5)), 0
    )


def at(displacement_px: np.ndarray, place_px: np.ndarray) -> np.ndarray:
    """Bilinear value of (H, W, 2) displacements between pixels."""
    u, v = np.floor(place_px).astype(int)
    right, down = place_px - (u, v)
    rows = displacement_px[v : v + 2, u : u + 2]
    upper, lower = rows[:, 0] * (1 - right) + rows[:, 1] * right
    return np.asarray(upper * (1 - down) + lower * down)


def marker_errors_px(
    first: FrameSpec, second: FrameSpec, eye: Eye, to: Eye, found: PixelMatches, seen: SurfacePasses
) -> list[float]:
    """By marker, distance from where the displacements send its centre to where it is."""
    errors = []
    for index, center_m in enumerate(marker_layout(first.drogue).centers_m):
        place = first.rig.image(first.left_from_drogue.apply(center_m), eye)
        u, v = np.floor(place).astype(int)
        if not (seen.part_id[v : v + 2, u : u + 2] == FIRST_MARKER_ID + index).all():
            continue
        wanted = second.rig.image(second.left_from_drogue.apply(center_m), to)
        errors.append(float(np.linalg.norm(place + at(found.displacement_px, place) - wanted)))
    return errors


@pytest.mark.parametrize("eye", EYES)
def test_flow_takes_marker_centres_to_their_next_labels(frame: FrameSpec, eye: Eye) -> None:
    after, seen = moved(frame), passes(frame, eye)
    found = flow_matches(frame, after, eye, seen, passes(after, eye))
    errors = marker_errors_px(frame, after, eye, eye, found, seen)
    # Depths have float32; the flow of a plane is not linear between pixels, by less than this.
    assert len(errors) >= 6 and max(errors) < 1e-4
    assert np.abs(found.displacement_px[seen.part_id > 0]).max() > 3


@pytest.mark.parametrize("eye", EYES)
def test_disparity_takes_marker_centres_to_the_other_eye(frame: FrameSpec, eye: Eye) -> None:
    seen = passes(frame, eye)
    found = stereo_matches(frame.rig, eye, seen, passes(frame, OTHER[eye]))
    errors = marker_errors_px(frame, frame, eye, OTHER[eye], found, seen)
    assert len(errors) >= 6 and max(errors) < 1e-4
    assert np.abs(found.displacement_px[..., 1]).max() < 1e-9


def test_disparity_is_opencv_s(frame: FrameSpec) -> None:
    seen = passes(frame, "left")
    found = stereo_matches(frame.rig, "left", seen, passes(frame, "right"))
    disparity = -found.displacement_px[..., 0].astype(np.float32)
    points = cv2.reprojectImageTo3D(disparity, opencv_stereo_matrices(frame.rig)["Q"])
    near = np.isfinite(seen.depth_m)
    np.testing.assert_allclose(points[near, 2], seen.depth_m[near], rtol=1e-5)
    np.testing.assert_allclose(disparity[~near], 0, atol=1e-9)


def test_lenses_bend_matches_as_opencv_s_projection_does() -> None:
    recipe = build_recipe(
        name="lenses", seed=3, rig={**RIG_320_PX, "preset": "paper-real"}, frames={"count": 1}, distance=stations(2.0)
    )
    frame = sample_frame(recipe, 0)
    after = moved(frame)

    def flat_passes(frame: FrameSpec, eye: Eye) -> SurfacePasses:
        drawn = pixel_passes(flat_drogue(frame.drogue), EyeView(frame.rig, eye, frame.left_from_drogue))
        return SurfacePasses(drawn.part_id, drawn.depth_m, drawn.normal)

    seen, later = flat_passes(frame, "right"), flat_passes(after, "right")
    found = flow_matches(frame, after, "right", seen, later)
    lens = frame.rig.lens("right")
    centers_m, errors = marker_layout(frame.drogue).centers_m, []
    for center_m in centers_m:
        images = []
        for one in (frame, after):
            turn, _ = cv2.Rodrigues(lens.ideal_from_real.T @ one.left_from_drogue.rotation)
            shift = lens.ideal_from_real.T @ (one.left_from_drogue.translation_m - one.rig.eye_offset_m("right"))
            image, _ = cv2.projectPoints(
                center_m[None], turn, shift, lens.camera.matrix(), lens.distortion.coefficients()
            )
            images.append(image[0, 0])
        errors.append(np.linalg.norm(images[0] + at(found.displacement_px, images[0]) - images[1]))
    # Displacements between pixels are not linear: with lenses by somewhat more.
    assert len(errors) == 8 and max(errors) < 1e-3
    between = stereo_matches(frame.rig, "left", flat_passes(frame, "left"), seen)
    # Rows of eyes that are not rectified differ.
    assert 0.5 < np.nanmax(np.abs(between.displacement_px[..., 1])) < 40


def finer(rig: StereoRig, times: int) -> StereoRig:
    """The rig with so many times as many pixels a side; centre i of a pixel lies at times * (i + 0.5) - 0.5."""
    c = rig.camera
    camera = PinholeCamera(
        c.width_px * times,
        c.height_px * times,
        c.fx_px * times,
        c.fy_px * times,
        (c.cx_px + 0.5) * times - 0.5,
        (c.cy_px + 0.5) * times - 0.5,
    )
    return StereoRig(camera, rig.baseline_m, rig.body_from_left, rig.probe_tip_body_m)


@pytest.mark.parametrize("eye", EYES)
def test_hidden_pixels_are_those_of_a_finer_z_buffer(frame: FrameSpec, eye: Eye) -> None:
    seen, other = passes(frame, eye), passes(frame, OTHER[eye])
    found = stereo_matches(frame.rig, eye, seen, other)
    times = 4
    fine = draw_eye(frame.model_copy(update={"rig": finer(frame.rig, times)}), OTHER[eye])
    height, width = seen.depth_m.shape
    target = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + found.displacement_px
    u, v = np.moveaxis(np.rint((target + 0.5) * times - 0.5).astype(int), -1, 0)
    inside = (u >= 0) & (u < width * times)
    assert (~inside == found.outside).mean() > 0.999
    there_m = fine.depth_m[np.where(inside, v, 0), np.where(inside, u, 0)]
    hidden = inside & (there_m < seen.depth_m * 0.98)
    assert hidden.sum() > 200
    # The two may differ only beside an edge of the coarser picture, by which it knows no better.
    nearness = 1 / other.depth_m
    edges = cv2.dilate(nearness, np.ones((3, 3))) > 1.01 * cv2.erode(nearness, np.ones((3, 3)))
    column, row = np.clip(np.rint(target).astype(int), 0, (width - 1, height - 1)).transpose(2, 0, 1)
    wrong = (hidden != found.hidden) & inside
    assert wrong.sum() < 0.05 * hidden.sum()
    # Ribs thinner than a pixel may lie between pixel centres, far from any edge that they see.
    assert (wrong & ~edges[row, column]).sum() < 5


def plane(frame: FrameSpec, part: Part, depth_m: float) -> SurfacePasses:
    """A plane of one part, across the axis."""
    camera = frame.rig.camera
    shape = (camera.height_px, camera.width_px)
    normal = np.broadcast_to(np.float32([0, 0, -1]), (*shape, 3))
    return SurfacePasses(np.full(shape, part, np.uint8), np.full(shape, depth_m, np.float32), normal)


def sky(frame: FrameSpec) -> SurfacePasses:
    camera = frame.rig.camera
    shape = (camera.height_px, camera.width_px)
    return SurfacePasses(
        np.zeros(shape, np.uint8), np.full(shape, np.inf, np.float32), np.zeros((*shape, 3), np.float32)
    )


def test_the_sky_moves_by_the_camera_s_turn(frame: FrameSpec) -> None:
    seen = sky(frame)
    found = flow_matches(frame, moved(frame), "left", seen, seen)
    matrix = frame.rig.camera.matrix()
    turn = matrix @ CAMERA_TURNS.rotation.T @ np.linalg.inv(matrix)
    height, width = seen.depth_m.shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    wanted = cv2.perspectiveTransform(pixels, turn) - pixels
    np.testing.assert_allclose(found.displacement_px, wanted, atol=1e-9)
    assert found.known.all() and not found.hidden.any() and found.outside.any()


def test_ground_and_clouds_that_pass_by_are_unknown(frame: FrameSpec) -> None:
    # Level flight: the horizon is the middle row.
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    start = frame.model_copy(update={"world_from_left": RigidTransform(level, np.zeros(3))})
    clear = start.environment.model_copy(update={"ground": "sea", "clouds": ()})
    cloud = CloudLayer(
        height_above_camera_m=1000, cover_fraction=0.3, feature_size_m=500, optical_depth=10, texture_seed=1
    )
    cloudy = clear.model_copy(update={"clouds": (cloud,)})
    known = {}
    for name, old in (("clear", clear), ("cloudy", cloudy)):
        new = old.model_copy(update={"camera_offset_m": (5.0, 0.0)})
        before = start.model_copy(update={"environment": old})
        after = start.model_copy(update={"environment": new})
        known[name] = flow_matches(before, after, "left", sky(start), sky(start)).known
        assert flow_matches(before, before, "left", sky(start), sky(start)).known.all()
    horizon = frame.rig.camera.cy_px
    rows = np.arange(known["clear"].shape[0])
    np.testing.assert_array_equal(known["clear"].all(axis=1), rows < horizon)
    np.testing.assert_array_equal(known["clear"].any(axis=1), rows < horizon)
    assert not known["cloudy"].any()


def test_each_body_moves_by_its_own_pose(frame: FrameSpec) -> None:
    probe = Obstacle(
        kind="probe",
        shape=ObstacleShape(form="bar", radius_m=0.03, length_m=1.0),
        left_from_object=exp_twist([0.3, 0.2, 1.0, 0.0, 0.0, 0.0]),
        reflectance_rgb=(0.3, 0.3, 0.3),
    )
    bar = probe.model_copy(update={"kind": "obstacle"})
    shift = exp_twist([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    tanker = exp_twist([0.0, -1.0, 12.0, 0.0, 0.0, 0.0])
    before = frame.model_copy(update={"bystanders": (probe, bar, bar), "left_from_tanker": tanker})
    after = before.model_copy(
        update={
            "bystanders": (
                probe,
                bar.model_copy(update={"left_from_object": shift @ bar.left_from_object}),
                bar.model_copy(update={"left_from_object": shift @ bar.left_from_object}),
            ),
            "left_from_tanker": shift.inverse() @ tanker,
        }
    )

    def flow(part: Part, later: FrameSpec = after) -> np.ndarray:
        seen = plane(frame, part, 2.0)
        return flow_matches(before, later, "left", seen, seen).displacement_px

    shift_px = frame.rig.camera.fx_px * 0.1 / 2.0
    np.testing.assert_allclose(flow(Part.PROBE), 0.0, atol=1e-9)
    np.testing.assert_allclose(
        flow(Part.OBSTACLE), np.broadcast_to([shift_px, 0.0], flow(Part.OBSTACLE).shape), atol=1e-6
    )
    np.testing.assert_allclose(flow(Part.TANKER), np.broadcast_to([-shift_px, 0.0], flow(Part.TANKER).shape), atol=1e-6)
    # Two bodies with one part id that move apart, and bodies that only one of the frames has.
    apart = after.model_copy(update={"bystanders": (probe, bar, after.bystanders[2])})
    gone = after.model_copy(update={"bystanders": (probe, bar)})
    for other in (apart, gone):
        assert np.isnan(flow(Part.OBSTACLE, other)).all()
    assert np.isnan(flow(Part.TANKER, after.model_copy(update={"left_from_tanker": None}))).all()


def test_points_of_a_bending_hose_keep_their_place_on_its_mesh(frame: FrameSpec) -> None:
    along = np.linspace(0.0, 12.0, 17)
    nodes = np.stack([0.02 * along, -0.05 * along**1.5, frame.left_from_drogue.translation_m[2] + 0.6 + along], axis=-1)
    before = frame.model_copy(update={"hose_nodes_left_m": nodes})
    after = moved(
        before, hose_nodes_left_m=nodes + np.stack([0.1 * np.sin(along), -0.02 * along, 0.01 * along], axis=-1)
    )
    rng = np.random.default_rng(4)
    surfaces = []
    for one in (before, after):
        inside = one.left_from_drogue.inverse().apply(one.hose_nodes_left_m)
        mesh = hose_mesh(inside, frame.drogue.hose_radius_m)
        surfaces.append(one.left_from_drogue.apply(mesh.vertices)[mesh.faces])
    # The caps are last; a ray sees them only from behind the coupling.
    count = len(surfaces[0]) - 128
    face, weight = rng.integers(0, count, 40), rng.dirichlet((1, 1, 1), 40)
    old, new = ((corners[face] * weight[..., None]).sum(axis=1) for corners in surfaces)
    camera = frame.rig.camera
    place = camera.project(old)
    # One pixel for each point: its ray is that of the pixel, so the rig is shifted until it sees the point there.
    errors = []
    for point, image, wanted in zip(old, place, new, strict=True):
        here = PinholeCamera(1, 1, camera.fx_px, camera.fy_px, camera.cx_px - image[0], camera.cy_px - image[1])
        rig = StereoRig(here, frame.rig.baseline_m)
        first, second = (one.model_copy(update={"rig": rig}) for one in (before, after))
        seen = SurfacePasses(np.array([[Part.HOSE]], np.uint8), np.array([[point[2]]]), np.zeros((1, 1, 3), np.float32))
        found = flow_matches(first, second, "left", seen, seen).displacement_px[0, 0]
        errors.append(np.linalg.norm(found - here.project(wanted)))
    assert np.linalg.norm(camera.project(new) - place, axis=1).max() > 5
    # A triangle is flat where the surface between two rings is ruled.
    assert max(errors) < 0.005


def test_points_behind_the_camera_are_unknown(frame: FrameSpec) -> None:
    seen = plane(frame, Part.FACE, 2.0)
    behind = frame.model_copy(
        update={"left_from_drogue": exp_twist([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]) @ frame.left_from_drogue}
    )
    found = flow_matches(frame, behind, "left", seen, seen)
    assert not found.known.any() and not found.hidden.any() and not found.outside.any()
