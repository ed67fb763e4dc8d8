"""Probes, cockpits, distractors and hoses: closed solids of their sizes, with paint that depends on the seed alone."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drogue_models.obstacles import COCKPIT_FORMS, DISTRACTOR_BODIES, PLAIN_FORMS, PROBE_FORMS, ObstacleShape
from drogue_models.painted_mesh import HIGHEST_REFLECTANCE, LOWEST_REFLECTANCE, PaintedMesh
from drogue_models.parameters import DrogueParameters, even_ring
from drogue_models.surface_looks import HoseBand, HoseLook
from drogue_models.surroundings.bystanders import bystander_surface
from drogue_models.surroundings.hose_surface import hose_surface

GREY = (0.4, 0.41, 0.42)
PAINTED = (*PROBE_FORMS, *COCKPIT_FORMS, *DISTRACTOR_BODIES)
SIZES_M = {
    "nose": (0.5, 3.0, 0.05),
    "canopy-frame": (0.4, 0.6, 0.02),
    "glare-shield": (0.6, 0.4, 0.02),
    "nacelle": (1.0, 4.2, 0.05),
    "intake": (0.9, 2.0, 0.05),
    "wheel": (0.5, 1.0, 0.05),
    "antenna": (0.2, 0.3, 0.05),
    "roundel": (0.7, 1.0, 0.006),
    "lamp": (0.06, 1.0, 0.05),
    "bird": (0.65, 1.0, 0.05),
    "pod": (0.41, 4.2, 0.05),
}


def shape(form: str, seed: int = 3, mirrored: bool = False) -> ObstacleShape:
    radius_m, length_m, tube_m = SIZES_M.get(form, (0.04, 6.0, 0.05))
    return ObstacleShape.model_validate(
        {
            "form": form,
            "radius_m": radius_m,
            "length_m": length_m,
            "tube_radius_m": tube_m,
            "seed": seed,
            "mirrored": mirrored,
        }
    )


def whole(painted: PaintedMesh) -> trimesh.Trimesh:
    """The mesh with vertices joined again along creases and seams."""
    mesh = trimesh.Trimesh(painted.mesh.vertices, painted.mesh.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


@pytest.mark.parametrize("form", PAINTED)
@pytest.mark.parametrize("seed", [1, 8, 77])
def test_every_body_is_closed_with_its_surface_outwards(form: str, seed: int) -> None:
    mesh = whole(bystander_surface(shape(form, seed, mirrored=seed == 8), GREY))
    bodies = mesh.split(only_watertight=False)
    assert len(bodies) > 0
    for body in bodies:
        assert body.is_watertight and body.is_winding_consistent
        # In float64 the volume of a solid that is turned inside out is negative.
        assert body.volume > 0


@pytest.mark.parametrize("form", PAINTED)
def test_paint_is_a_map_in_range_with_coordinates_for_every_vertex(form: str) -> None:
    painted = bystander_surface(shape(form), GREY)
    assert painted.has_map and painted.uv is not None
    assert painted.reflectance.min() >= LOWEST_REFLECTANCE - 1e-6
    assert painted.reflectance.max() <= HIGHEST_REFLECTANCE + 1e-6
    assert painted.reflectance.shape[0] <= 512 and painted.reflectance.shape[1] <= 256
    # Not one flat grey: the map varies by several percent of its mean.
    assert painted.contrast > 0.04


@pytest.mark.parametrize("form", PAINTED)
def test_normals_that_are_interpolated_lean_outwards(form: str) -> None:
    mesh = bystander_surface(shape(form), GREY).mesh
    corners = mesh.vertex_normals[mesh.faces]
    # At the tip of a nacelle's plug, a cone of 27 degrees, the normal is along the axis: 77 degrees from its faces.
    assert np.einsum("fcx,fx->fc", corners, mesh.face_normals).min() > 0.2


@pytest.mark.parametrize("form", PAINTED)
def test_another_seed_changes_the_look_and_the_same_seed_repeats_it(form: str) -> None:
    first, again, other = (bystander_surface.__wrapped__(shape(form, seed), GREY) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.reflectance, again.reflectance)
    np.testing.assert_array_equal(first.mesh.vertices, again.mesh.vertices)
    assert other.reflectance.shape != first.reflectance.shape or (other.reflectance != first.reflectance).any()


@pytest.mark.parametrize("form", PROBE_FORMS)
def test_a_probe_begins_at_its_tip_and_reaches_behind_the_cameras(form: str) -> None:
    low, high = whole(bystander_surface(shape(form), GREY)).bounds
    assert low[2] == pytest.approx(0.0, abs=1e-12)
    assert high[2] > 4.0
    # The nozzle's collar is its widest part in the front half metre.
    mesh = whole(bystander_surface(shape(form), GREY))
    front = mesh.vertices[mesh.vertices[:, 2] < 0.3]
    assert np.hypot(front[:, 0], front[:, 1]).max() == pytest.approx(0.047, rel=1e-6)


@pytest.mark.parametrize("form", ["probe-cranked", "probe-retractable"])
def test_a_probe_of_the_left_side_is_the_mirrored_one(form: str) -> None:
    right, left = (whole(bystander_surface(shape(form, mirrored=mirrored), GREY)) for mirrored in (False, True))
    # Both bend towards their own side's inside.
    assert right.bounds[1, 0] == pytest.approx(-left.bounds[0, 0], rel=1e-3)


def test_shapes_in_space_differ_by_form() -> None:
    ends = {
        form: tuple(np.round(whole(bystander_surface(shape(form), GREY)).bounds.ravel(), 3)) for form in PROBE_FORMS
    }
    # Straight tube and boom share a line, but not their thickness.
    assert len(set(ends.values())) == len(PROBE_FORMS)


def test_a_lamp_shines_with_its_luminance_and_nothing_else_does() -> None:
    red = (1.0, 0.05, 0.02)
    lamp = bystander_surface(shape("lamp"), red, 5000.0)
    assert lamp.emission_cd_m2 @ [0.2126, 0.7152, 0.0722] == pytest.approx(5000.0)
    assert lamp.emission_cd_m2[0] > 10 * lamp.emission_cd_m2[1]
    assert all(bystander_surface(shape(form), GREY).emission_cd_m2.max() == 0 for form in PAINTED)


def test_plain_forms_keep_one_colour() -> None:
    for form in PLAIN_FORMS:
        painted = bystander_surface(ObstacleShape(form=form, radius_m=0.2), GREY)
        np.testing.assert_allclose(painted.reflectance, GREY, rtol=1e-6)


def test_only_bodies_of_revolution_have_a_profile() -> None:
    with pytest.raises(ValueError, match="form: bird is no body of revolution"):
        shape("bird").profile_m()


DROGUE = DrogueParameters(name="ring", marker_positions_m=even_ring(8, 0.27))
STRAIGHT = np.column_stack([np.zeros((21, 2)), np.linspace(0.0, 20.0, 21)])


def rows_at(painted: PaintedMesh, along_m: float) -> np.ndarray:
    """(3,) mean paint at a distance from the coupling."""
    row = int(along_m / 20.0 * painted.reflectance.shape[0])
    return painted.reflectance[row].mean(axis=0)


def test_bands_are_where_they_are_told_along_the_hose() -> None:
    band = HoseBand(start_m=3.0, end_m=4.5, reflectance_rgb=(0.6, 0.6, 0.6))
    look = HoseLook(reflectance_rgb=(0.05, 0.05, 0.05), bands=(band,), seed=4)
    painted = hose_surface(DROGUE, STRAIGHT, look)
    # Grime takes up to 35 %.
    assert rows_at(painted, 3.1).mean() > 0.35 and rows_at(painted, 4.4).mean() > 0.35
    assert rows_at(painted, 2.9).mean() < 0.06 and rows_at(painted, 4.6).mean() < 0.06
    assert painted.uv is not None
    # v runs along the hose: vertices 3.75 m from the coupling see the middle of the band.
    near = np.abs(np.asarray(painted.mesh.vertices)[:, 2] - 3.75) < 0.2
    assert np.abs(painted.uv[near, 1] - 3.75 / 20.0).max() < 0.011


def test_a_hose_is_satin_only_where_told_and_plain_without_a_look() -> None:
    matt = HoseLook(reflectance_rgb=(0.05, 0.05, 0.05))
    assert hose_surface(DROGUE, STRAIGHT, matt).sheen is None
    satin = hose_surface(DROGUE, STRAIGHT, matt.model_copy(update={"sheen_fraction": 0.05, "roughness": 0.3})).sheen
    assert satin is not None and (satin.fraction, satin.roughness) == (0.05, 0.3)
    plain = hose_surface(DROGUE, STRAIGHT, None)
    np.testing.assert_allclose(plain.reflectance, DROGUE.structure_reflectance_rgb, rtol=1e-6)


def test_a_band_has_a_length() -> None:
    with pytest.raises(ValueError, match="start_m: must be below end_m"):
        HoseBand(start_m=2.0, end_m=2.0, reflectance_rgb=(0.5, 0.5, 0.5))
