"""Baskets, leaves, ribbons and cones: closed solids of the stated sizes, behind the rim plane and inside the rim."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial import ConvexHull, cKDTree

from drogue_models.bodies import (
    BODY_FAMILIES,
    BasketBody,
    Canopy,
    ConeBody,
    DrogueBody,
    PetalBody,
    ReceptionCoupling,
    RibbonBody,
    RimLamps,
)
from drogue_models.drogue_families.body_symmetry import body_symmetry_order
from drogue_models.meshes import drogue_meshes
from drogue_models.parameters import DrogueParameters, even_ring
from drogue_models.parts import FIRST_MARKER_ID, Part, marker_id
from drogue_models.presets import PRESETS, load_drogue, preset_names
from scenes.framing import outline_points_m

FAMILIES = [name for name in preset_names() if name not in PRESETS]


def with_body(body: DrogueBody, **changes: object) -> DrogueParameters:
    """A drogue with a body and without markers."""
    return DrogueParameters.model_validate(
        {"name": "drawn", "marker_positions_m": (), "hub": None, "rim_tube_radius_m": 0.004, "body": body} | changes
    )


def check_solids(drogue: DrogueParameters) -> dict[int, trimesh.Trimesh]:
    meshes = drogue_meshes(drogue)
    for part, mesh in meshes.items():
        assert mesh.is_watertight and mesh.is_winding_consistent, part
        assert min(solid.volume for solid in mesh.split()) > 0, part
        assert mesh.area_faces.min() > 0, part
        vertices = np.asarray(mesh.vertices)
        assert vertices[:, 2].min() >= 0, part
        # One rounding of a cosine times the radius.
        assert np.hypot(vertices[:, 0], vertices[:, 1]).max() <= drogue.rim_radius_m + 1e-15, part
    return meshes


@pytest.mark.parametrize("name", FAMILIES)
def test_shipped_bodies_are_closed_and_lie_behind_the_rim_and_inside_it(name: str) -> None:
    drogue = load_drogue(name)
    assert drogue.name == name
    meshes = check_solids(drogue)
    assert int(Part.FACE) not in meshes
    assert {int(Part.RIM), int(Part.CANOPY), int(Part.COUPLING)} <= set(meshes)
    assert (int(Part.HUB) in meshes) == (drogue.hub is not None)
    assert sum(part >= FIRST_MARKER_ID for part in meshes) == drogue.marker_count


@pytest.mark.parametrize("name", FAMILIES)
def test_sizes_are_the_stated_ones(name: str) -> None:
    drogue = load_drogue(name)
    meshes = drogue_meshes(drogue)
    rim, coupling = np.asarray(meshes[int(Part.RIM)].vertices), meshes[int(Part.COUPLING)]
    # The rim's torus is a polygon with a corner on +x: its extent along x is the diameter but for rounding.
    assert np.ptp(rim[:, 0]) == pytest.approx(2 * drogue.rim_radius_m, rel=1e-12)
    assert rim[:, 2].min() == 0
    # Bolts stand 3 mm before the flange.
    assert 0 <= drogue.hub_depth_m - coupling.bounds[0][2] <= 0.003 + 1e-12
    assert coupling.bounds[1][2] == pytest.approx(drogue.hub_depth_m + drogue.coupling_length_m, rel=1e-12)


def test_shipped_bodies_span_the_sizes_and_looks_that_they_are_for() -> None:
    drogues = [load_drogue(name) for name in FAMILIES]
    diameters = [2 * drogue.rim_radius_m for drogue in drogues]
    large = [size for size, drogue in zip(diameters, drogues, strict=True) if not isinstance(drogue.body, ConeBody)]
    small = [size for size, drogue in zip(diameters, drogues, strict=True) if isinstance(drogue.body, ConeBody)]
    assert min(large) == pytest.approx(0.45) and max(large) == pytest.approx(0.85)
    assert min(small) >= 0.20 and max(small) <= 0.35
    baskets = [drogue for drogue in drogues if isinstance(drogue.body, BasketBody)]
    assert min(drogue.rib_count for drogue in baskets) == 24 and max(drogue.rib_count for drogue in baskets) == 36
    assert {drogue.body.canopy.style for drogue in baskets if isinstance(drogue.body, BasketBody)} == {
        "pleated", "segmented", "smooth", "tube",
    }  # fmt: skip
    assert sum(drogue.marker_count == 0 for drogue in drogues) >= len(drogues) / 2


@st.composite
def bodies(draw: st.DrawFn) -> DrogueParameters:
    """Any drogue with a body that the type accepts; only what cannot fit together is left out."""

    def share(low: float, high: float) -> float:
        return draw(st.floats(low, high))

    small = draw(st.booleans())
    common = {
        "flare": share(-0.9, 0.9),
        "depth_m": share(0.10, 0.2) if small else share(0.18, 0.45),
        "coupling": ReceptionCoupling(
            throat_radius_m=0.010 if small else 0.03, guide_length_m=0.015 if small else 0.04,
            roller_count=draw(st.integers(0, 16)), bolt_count=0,
        ),
        "lamps": draw(st.sampled_from([None, RimLamps(count=7, radius_m=share(0.002, 0.012))])),
    }  # fmt: skip
    family = draw(st.sampled_from(BODY_FAMILIES))
    body: DrogueBody
    if family == "basket":
        canopy = Canopy(
            style=draw(st.sampled_from(["pleated", "segmented", "smooth", "tube"])), length_m=share(0.02, 0.1),
            billow_m=share(0, 0.05), folds_per_strut=draw(st.integers(1, 6)), fold_depth_m=share(0, 0.02),
            segment_count=draw(st.integers(2, 40)), gap_fraction=share(0.01, 0.6),
        )  # fmt: skip
        body = BasketBody(
            **common, canopy=canopy, strut_width_m=share(0.002, 0.02), strut_root_width_m=share(0.002, 0.02),
            strut_thickness_m=share(0.001, 0.008), cord_rings=draw(st.integers(0, 16)),
        )  # fmt: skip
    elif family == "petals":
        body = PetalBody(
            **common, sheet_m=share(5e-4, 5e-3), overlap_fraction=share(0.02, 0.4), root_fraction=share(0.2, 0.95),
            tip_m=share(0, 0.04),
        )  # fmt: skip
    elif family == "ribbons":
        body = RibbonBody(
            **common, ribbon_count=draw(st.integers(2, 12)), slot_fraction=share(0.15, 0.45),
            covered_fraction=share(0.3, 0.9), strap_width_m=share(0.002, 0.05), billow_m=share(0, 0.03),
        )  # fmt: skip
    else:
        body = ConeBody(
            **common, wall_m=share(8e-4, 6e-3), window_count=draw(st.integers(0, 36)),
            window_rows=draw(st.integers(1, 4)), web_fraction=share(0.1, 0.8),
        )  # fmt: skip
    return with_body(
        body,
        rim_radius_m=share(0.10, 0.175) if small else share(0.20, 0.45),
        rim_tube_radius_m=share(0.001, 0.006),
        coupling_radius_m=0.03 if small else 0.085,
        coupling_length_m=0.08 if small else 0.2,
        hose_radius_m=0.006 if small else 0.03,
        rib_count=draw(st.integers(6, 96)),
    )


@settings(max_examples=10)
@given(drogue=bodies())
def test_any_body_is_closed_behind_the_rim_plane_and_inside_the_rim(drogue: DrogueParameters) -> None:
    meshes = check_solids(drogue)
    # Framing keeps the outline in view, so it must enclose the body.
    hull = ConvexHull(outline_points_m(drogue))
    points = np.concatenate([np.asarray(mesh.vertices) for mesh in meshes.values()])
    beyond_m = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max()
    # The outline's circles have 72 corners: 0.1 % of the radius; bars at the root stand out by half their width.
    assert beyond_m < 0.001 * drogue.rim_radius_m + 0.004


def test_markers_lie_at_their_depths_and_fill_their_holders() -> None:
    drogue = load_drogue("basket-strut-markers")
    meshes = drogue_meshes(drogue)
    ribs = {tuple(vertex) for vertex in np.asarray(meshes[int(Part.RIBS)].vertices)}
    assert len({depth for _, _, depth in drogue.marker_centers_m}) == 2
    for index, (x, y, depth) in enumerate(drogue.marker_centers_m):
        mesh = meshes[marker_id(index)]
        assert mesh.bounds[0][2] == depth
        triangles = np.asarray(mesh.triangles)
        front = triangles[(triangles[:, :, 2] == depth).all(axis=1)]
        areas = np.linalg.norm(np.cross(front[:, 1] - front[:, 0], front[:, 2] - front[:, 0]), axis=1) / 2
        assert areas.sum() == pytest.approx(np.pi * drogue.marker_radius_m**2, rel=1e-12)
        centroid = (front.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
        np.testing.assert_allclose(centroid, [x, y, depth], rtol=0, atol=1e-14)
        assert {tuple(vertex) for vertex in front.reshape(-1, 3)} <= ribs


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"marker_depths_m": (0.01,)}, "marker_depths_m: must be one for each of the 6 markers"),
        ({"marker_depths_m": (0.276,) * 6}, "marker_depths_m: marker 0 must lie before the coupling at 0.28 m"),
        ({"marker_depths_m": (0.2,) * 6}, "marker_positions_m: marker 0 with its holder must lie within"),
        (
            {"marker_positions_m": even_ring(32, 0.26), "marker_depths_m": ()},
            "marker_positions_m: markers 0 and 1 overlap",
        ),
        ({"hub": {"depth_m": 0.2}}, "hub.depth_m: must be body.depth_m"),
        ({"coupling_radius_m": 0.318}, "coupling_radius_m: must be below 0.31 m"),
        ({"rib_count": 3}, "rib_count: a body of basket needs at least 6"),
        ({"body": BasketBody(coupling={"throat_radius_m": 0.08})}, "body.coupling.throat_radius_m: must be below"),
        ({"body": BasketBody(coupling={"guide_length_m": 0.19})}, "body.coupling.guide_length_m: must be below"),
        ({"body": BasketBody(depth_m=0.02)}, "body.depth_m: must exceed"),
        ({"body": BasketBody(lamps={"count": 6})}, "marker_positions_m: marker 0 overlaps a lamp"),
        (
            {
                "body": BasketBody(lamps={"count": 48, "radius_m": 0.025}),
                "marker_positions_m": (),
                "marker_depths_m": (),
            },
            "body.lamps: do not fit side by side",
        ),
        ({"body_mesh": {"path": "x.ply", "sha256": "0" * 64}}, "body: leave it out, or leave out body_mesh"),
    ],
)
def test_what_does_not_fit_together_names_its_key(changes: dict[str, object], message: str) -> None:
    fine = {"marker_positions_m": even_ring(6, 0.27), "marker_radius_m": 0.02, "marker_depths_m": (0.015,) * 6}
    with_body(BasketBody(), **fine)
    with pytest.raises(ValidationError, match=message.replace(".", r"\.")):
        with_body(**({"body": BasketBody()} | fine | changes))  # type: ignore[arg-type]


def test_flat_face_takes_no_depths() -> None:
    with pytest.raises(ValidationError, match="marker_depths_m: markers lie in the flat face"):
        DrogueParameters(name="flat", marker_positions_m=even_ring(3, 0.27), marker_depths_m=(0.0, 0.1, 0.0))


def test_new_fields_leave_the_json_of_other_drogues_as_it_was() -> None:
    for drogue in PRESETS.values():
        assert {"body", "marker_depths_m"}.isdisjoint(drogue.model_dump())
        assert DrogueParameters.model_validate_json(drogue.model_dump_json()) == drogue
    for name in FAMILIES:
        drogue = load_drogue(name)
        assert DrogueParameters.model_validate_json(drogue.model_dump_json()) == drogue


def test_the_families_are_those_of_the_bodies() -> None:
    bodies, _ = get_args(DrogueBody)
    assert tuple(body.model_fields["family"].default for body in get_args(bodies)) == BODY_FAMILIES


def maps_onto_itself(vertices_m: np.ndarray, order: int) -> bool:
    angle = 2 * np.pi / order
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    gaps_m, _ = cKDTree(vertices_m).query(vertices_m @ turn.T)
    return bool(gaps_m.max() < 1e-9)


@pytest.mark.parametrize("name", [name for name in FAMILIES if load_drogue(name).marker_count == 0])
def test_the_symmetry_of_a_body_is_that_of_its_mesh(name: str) -> None:
    order = body_symmetry_order(load_drogue(name))
    meshes = drogue_meshes(load_drogue(name))
    pieces = [piece for mesh in meshes.values() for piece in mesh.split()]
    # Round pieces are polygons, which fewer turns map onto themselves.
    beside_axis = [piece.vertices for piece in pieces if np.hypot(*piece.vertices[:, :2].mean(axis=0)) > 1e-6]
    if beside_axis:
        vertices_m = np.concatenate(beside_axis)
        assert maps_onto_itself(vertices_m, order)
        assert not any(maps_onto_itself(vertices_m, order * prime) for prime in (2, 3, 5, 7))
    elif order:
        assert name == "cone-white" and maps_onto_itself(meshes[int(Part.CANOPY)].vertices, order)
    else:
        assert name == "cone-orange"


def test_the_symmetry_of_a_flat_ring_is_that_of_its_ribs() -> None:
    plain = PRESETS["red-8"].model_copy(update={"marker_positions_m": ()})
    assert body_symmetry_order(plain) == 24
    assert body_symmetry_order(plain.model_copy(update={"rib_count": 0})) == 0
