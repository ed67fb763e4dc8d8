from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
import pytest
import trimesh

from drogue_models.tankers.airframe import Airframe, SourceDimension
from drogue_models.tankers.equipment import TUNNEL_DEPTH_M, TUNNEL_RADIUS_M, rotor_mesh, stowed_drogue
from drogue_models.tankers.planforms import airframe, grid_mesh
from drogue_models.tankers.tanker import PROPELLERS, STATIONS, Tanker, TankerType
from drogue_models.tankers.tanker_surfaces import tanker_surfaces
from scenes.sampler import sample_frame
from tests.support.recipe_builder import between, build_recipe

TYPES = list(STATIONS)
WITH_BOTH_PODS = [name for name, stations in STATIONS.items() if "left-pod" in stations]


def _bodies(frame: Airframe) -> list[tuple[str, trimesh.Trimesh]]:
    """All closed bodies but rotors, with their roles, in body axes."""
    return [
        (part.role, grid_mesh(part, left))
        for part in frame.grids
        for left in ((False, True) if part.mirrored else (False,))
    ]


def _triangles(tanker: Tanker) -> np.ndarray:
    return np.concatenate([np.asarray(surface.mesh.triangles) for surface in tanker_surfaces(tanker)])


class _Rays:
    """Rays against all triangles; a ray meets only those whose sphere it passes through."""

    def __init__(self, triangles: np.ndarray) -> None:
        self.triangles = triangles
        self._middles = triangles.mean(axis=1)
        self._radii = np.linalg.norm(triangles - self._middles[:, None], axis=-1).max(axis=1)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> tuple[float, float]:
        """Distance to the nearest triangle, infinite without one, and the cosine of its normal to the ray.

        Source: Moeller and Trumbore, Fast, Minimum Storage Ray/Triangle Intersection, 1997.
        """
        away = np.linalg.norm(np.cross(self._middles - origin, direction), axis=-1)
        near = self.triangles[away <= self._radii * (1 + 1e-9) + 1e-9]
        first, second, start = near[:, 1] - near[:, 0], near[:, 2] - near[:, 0], origin - near[:, 0]
        across, turned = np.cross(direction, second), np.cross(start, first)
        determinant = (first * across).sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (start * across).sum(axis=-1) / determinant
            v = turned @ direction / determinant
            distance = (second * turned).sum(axis=-1) / determinant
            distance[~((u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 1e-6))] = np.inf
        if not np.isfinite(distance).any():
            return np.inf, 0.0
        best = int(np.argmin(distance))
        normal = np.cross(first[best], second[best])
        return float(distance[best]), float(normal @ direction / np.linalg.norm(normal))


@pytest.mark.parametrize("name", TYPES)
def test_every_body_is_closed_and_outward(name: TankerType) -> None:
    for flaps_deg in (0.0, 30.0):
        for role, mesh in _bodies(airframe(name, flaps_deg)):
            assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, role


@pytest.mark.slow
@pytest.mark.parametrize("name", list(PROPELLERS))
@pytest.mark.parametrize("sweep_deg", [0.0, 20.0, 360.0])
def test_blades_are_closed_and_outward(name: TankerType, sweep_deg: float) -> None:
    for rotor in airframe(name, 0.0).rotors:
        assert rotor.blades == PROPELLERS[name].blades
        mesh = rotor_mesh(rotor, 25.0, sweep_deg)
        assert mesh.is_watertight and all(body.volume > 0 for body in mesh.split()[:40])


@pytest.mark.parametrize("name", list(PROPELLERS))
def test_blades_that_turn_cover_as_much_as_blades_that_stand(name: TankerType) -> None:
    rotor = airframe(name, 0.0).rotors[0]
    axis = np.array(rotor.axis)

    def covered_m2(sweep_deg: float) -> float:
        mesh = rotor_mesh(rotor, 0.0, sweep_deg)
        return float(np.abs((mesh.face_normals @ axis) * mesh.area_faces).sum()) / 2

    few, all_round = covered_m2(10.0), covered_m2(360.0 / rotor.blades)
    assert few == pytest.approx(all_round, rel=1e-6)
    # The slivers have straight edges from root to tip; a standing blade is up to 18 % wider between, and thick.
    assert covered_m2(0.0) == pytest.approx(all_round, rel=0.2)


def _measured_m(frame: Airframe, dimension: SourceDimension) -> float:
    bodies = _bodies(frame)
    bounds = {role: np.array([mesh.bounds for name, mesh in bodies if name == role]) for role, _ in bodies}
    parts = [mesh.bounds for _, mesh in bodies]
    blades = [rotor_mesh(rotor, 0.0, 360.0).bounds for rotor in frame.rotors]
    with_rotors = np.array(parts + blades)
    match dimension.what.split("_"):
        case ["length"]:
            return float(np.ptp(np.array(parts)[..., 0]))
        case ["span"]:
            return float(np.ptp(np.array(parts)[..., 1]))
        case ["height"]:
            return float(np.ptp(with_rotors[..., 2]))
        case ["length", "with", "rotors"]:
            return float(np.ptp(with_rotors[..., 0]))
        case ["width", "with", "rotors"]:
            return float(np.ptp(with_rotors[..., 1]))
        case ["propeller", "diameter"]:
            across = np.ptp(blades[0], axis=0)
            return float(np.max(across))
        case [role, "span" | "width"]:
            return float(np.ptp(bounds[role][..., 1]))
    raise AssertionError(dimension.what)


@pytest.mark.parametrize("name", TYPES)
def test_dimensions_are_those_of_the_source(name: TankerType) -> None:
    frame = airframe(name, 0.0)
    assert frame.dimensions
    for dimension in frame.dimensions:
        assert _measured_m(frame, dimension) == pytest.approx(dimension.value_m, rel=0.02), dimension


@pytest.mark.parametrize("name", WITH_BOTH_PODS)
def test_left_and_right_stations_mirror_each_other(name: TankerType) -> None:
    def corners(side: str) -> np.ndarray:
        mesh = tanker_surfaces(Tanker(type=name, station=side))[0].mesh  # type: ignore[arg-type]
        points = np.asarray(mesh.vertices) * ([1.0, -1.0, 1.0] if side == "left-pod" else [1.0, 1.0, 1.0])
        return np.unique(np.round(points, 6), axis=0)

    left, right = corners("left-pod"), corners("right-pod")
    # Only the rounding of a vertex on the middle differs.
    assert len(left) == len(right)
    np.testing.assert_allclose(left.mean(axis=0), right.mean(axis=0), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(left, axis=0), np.ptp(right, axis=0), rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", TYPES)
def test_no_camera_sees_an_inner_face(name: TankerType) -> None:
    recipe = build_recipe(
        name="views",
        frames={"count": 25, "scenes": 25},
        distance=between(2.0, 40.0),
        exposure={"time_s": 0.002},  # so that no light is measured
        pose={"camera_bank_deg": [-30, 30], "camera_pitch_deg": [-15, 15]},
        tanker={"variants": [{"type": name, "paints": [{"scheme": "light-grey"}]}], "flaps_deg": 15},
    )
    rng, rays_of = np.random.default_rng(5), {}
    for index in range(recipe.frames.count):
        frame = sample_frame(recipe, index)
        assert frame.left_from_tanker is not None and frame.tanker is not None
        # Paint, lamps and the phase of the blades do not matter here.
        tanker = Tanker(type=name, station=frame.tanker.station, flaps_deg=frame.tanker.flaps_deg)
        if tanker not in rays_of:
            rays_of[tanker] = _Rays(_triangles(tanker))
        rays, eye = rays_of[tanker], frame.left_from_tanker.inverse().translation_m
        # Rays at places of the surface, so that each enters the silhouette.
        for aim in rays.triangles[rng.integers(len(rays.triangles), size=12)].mean(axis=1):
            distance, facing = rays.hit(eye, (aim - eye) / np.linalg.norm(aim - eye))
            assert np.isfinite(distance) and facing < 0


@pytest.mark.parametrize(
    "tanker", [Tanker(type=name, station=station) for name, stations in STATIONS.items() for station in stations]
)
def test_nothing_stands_in_the_hose_s_way(tanker: Tanker) -> None:
    rays = _Rays(_triangles(tanker))
    start = 0.02 if tanker.type == "multirotor" else 0.0
    for drop_deg in (2.0, 10.0, 25.0):
        for side_deg in (-4.0, 4.0):
            drop, side = np.radians(drop_deg), np.radians(side_deg)
            along = np.array([np.cos(drop) * np.cos(side), np.cos(drop) * np.sin(side), -np.sin(drop)])
            distance, _ = rays.hit(start * along + [0.001, 0.0, 0.0], along)
            assert distance == np.inf
    if tanker.type != "multirotor":
        # Forwards it is inside the tunnel.
        distance, facing = rays.hit(np.array([2.0, 0.001, 0.002]), np.array([-1.0, 0.0, 0.0]))
        assert 2.3 < distance < 3.0 and facing < 0


@pytest.mark.parametrize("name", TYPES)
def test_triangle_budget(name: TankerType) -> None:
    tanker = Tanker(type=name, station=STATIONS[name][0], flaps_deg=20.0, blade_sweep_deg=180.0)
    assert len(_triangles(tanker)) < 60_000


def _rear_view(name: TankerType) -> np.ndarray:
    """(256, 384) silhouette from behind, its span over three quarters of the width."""
    triangles = _triangles(Tanker(type=name, station=STATIONS[name][0]))
    points = triangles[..., 1:] - (triangles[..., 1:].min(axis=(0, 1)) + triangles[..., 1:].max(axis=(0, 1))) / 2
    scale = 288 / np.ptp(points[..., 0])
    pixels = np.stack([192 + scale * points[..., 0], 128 - scale * points[..., 1]], axis=-1)
    picture = np.zeros((256, 384), dtype=np.uint8)
    for corners in np.rint(pixels).astype(np.int32):
        cv2.fillConvexPoly(picture, corners, 1)
    return picture > 0


def test_silhouettes_from_behind_differ() -> None:
    views = {name: _rear_view(name) for name in TYPES}
    for first, second in combinations(TYPES, 2):
        overlap = (views[first] & views[second]).sum() / (views[first] | views[second]).sum()
        # At the same span; twins with pods under low and high wings overlap most.
        assert overlap < 0.75, (first, second, overlap)


def test_drogues_that_are_not_in_use_fit_their_tunnels() -> None:
    stowed = grid_mesh(stowed_drogue())
    assert stowed.is_watertight and stowed.volume > 0
    across = np.linalg.norm(np.asarray(stowed.vertices)[:, 1:], axis=1)
    assert across.max() < TUNNEL_RADIUS_M and stowed.bounds[0, 0] > -TUNNEL_DEPTH_M
    in_use = [
        len(tanker_surfaces(Tanker(type=name, station=stations[0])))
        for name, stations in (("four-jet", STATIONS["four-jet"]), ("fighter", STATIONS["fighter"]))
    ]
    assert in_use[0] == in_use[1] + 1
