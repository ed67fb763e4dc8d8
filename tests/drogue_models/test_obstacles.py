from __future__ import annotations

import numpy as np
import pytest

from drogue_models.meshes import obstacle_mesh
from drogue_models.obstacles import OBSTACLE_SECTIONS, ObstacleShape
from drogue_models.solids import with_creases

SHAPES = [
    ObstacleShape(form="probe", radius_m=0.04, length_m=5.0),
    ObstacleShape(form="bar", radius_m=0.01, length_m=2.0),
    ObstacleShape(form="ball", radius_m=0.3),
    ObstacleShape(form="disc", radius_m=0.3, length_m=0.02),
    ObstacleShape(form="ring", radius_m=0.3, tube_radius_m=0.05),
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.form)
def test_meshes_are_closed_and_look_outwards(shape: ObstacleShape) -> None:
    mesh = obstacle_mesh(shape)
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0


@pytest.mark.parametrize(
    ("shape", "volume_m3"),
    [
        (SHAPES[1], np.pi * 0.01**2 * 2.0),
        (SHAPES[2], 4 / 3 * np.pi * 0.3**3),
        (SHAPES[3], np.pi * 0.3**2 * 0.02),
        (SHAPES[4], 2 * np.pi**2 * 0.3 * 0.05**2),
    ],
    ids=lambda value: getattr(value, "form", None),
)
def test_volumes_are_those_of_the_ideal_bodies(shape: ObstacleShape, volume_m3: float) -> None:
    # Polygons of 64 and 32 corners lose (2 pi / n)^2 / 6 of a circle's area: 0.2 % and 0.6 %.
    assert obstacle_mesh(shape).volume == pytest.approx(volume_m3, rel=0.01)


def test_a_probe_has_its_tip_at_the_origin_and_its_nozzle_in_front() -> None:
    vertices = obstacle_mesh(SHAPES[0]).vertices
    assert vertices[:, 2].min() == 0.0
    assert np.hypot(vertices[:, 0], vertices[:, 1]).max() == pytest.approx(0.04)
    assert vertices[:, 2].max() == pytest.approx(5.0)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.form)
def test_creases_move_no_surface(shape: ObstacleShape) -> None:
    mesh, creased = obstacle_mesh(shape), with_creases(obstacle_mesh(shape))
    places = [np.sort(each.triangles_center, axis=0) for each in (mesh, creased)]
    np.testing.assert_allclose(places[0], places[1], atol=1e-12)
    assert creased.volume == pytest.approx(mesh.volume)


def test_a_ball_is_round_and_a_disc_keeps_its_edge() -> None:
    ball = with_creases(obstacle_mesh(SHAPES[2]))
    radial = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    # Normals of a mesh of 64 x 32 faces: a small part of the 5.6 degrees between two faces.
    assert (radial * ball.vertex_normals).sum(axis=1).min() > np.cos(np.radians(1.0))
    disc = with_creases(obstacle_mesh(SHAPES[3]))
    along = np.abs(disc.vertex_normals[:, 2])
    assert np.all((along < 1e-6) | (along > 1 - 1e-6))


def test_normals_of_a_tube_are_not_tilted_by_its_ends() -> None:
    probe = with_creases(obstacle_mesh(SHAPES[0]))
    vertices, normals = probe.vertices, probe.vertex_normals
    # Past the nozzle's last corner there is nothing but the tube, and its end cap.
    tube = (vertices[:, 2] > 0.04 * 6.0 - 1e-9) & (np.abs(normals[:, 2]) < 0.9)
    assert tube.sum() >= 2 * OBSTACLE_SECTIONS
    on_nozzle = tube & (np.abs(normals[:, 2]) > 0.3)
    assert np.abs(normals[tube & ~on_nozzle, 2]).max() < 1e-6
    assert (vertices[on_nozzle, 2] < 0.04 * 6.0 + 1e-9).all()
