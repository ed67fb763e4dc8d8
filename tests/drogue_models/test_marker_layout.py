from __future__ import annotations

import numpy as np
import pytest

from drogue_models.marker_layout import marker_layout
from drogue_models.parameters import DrogueParameters, even_ring
from drogue_models.presets import PRESETS, RING_RADIUS_M, load_drogue


@pytest.mark.parametrize("count", [5, 7, 8])
@pytest.mark.parametrize("color", ["red", "white"])
def test_presets_are_even_rings(count: int, color: str) -> None:
    layout = marker_layout(PRESETS[f"{color}-{count}"])
    assert layout.count == layout.symmetry_order == count
    assert layout.ring_radius_m == pytest.approx(RING_RADIUS_M, rel=1e-15)
    np.testing.assert_allclose(layout.centers_m[0], [0.0, RING_RADIUS_M, 0.0], rtol=0, atol=1e-15)
    gaps = np.linalg.norm(layout.centers_m - np.roll(layout.centers_m, -1, axis=0), axis=1)
    np.testing.assert_allclose(gaps, 2 * RING_RADIUS_M * np.sin(np.pi / count), rtol=1e-14)
    # Counter-clockwise from x towards y.
    assert np.all(np.cross(layout.centers_m, np.roll(layout.centers_m, -1, axis=0))[:, 2] > 0)


def test_presets_leave_ten_millimetres_of_face_around_every_marker() -> None:
    for drogue in PRESETS.values():
        radii = np.linalg.norm(drogue.marker_positions_m, axis=1)
        assert np.all(radii - drogue.marker_radius_m - drogue.face_inner_radius_m >= 0.01 - 1e-12)
        assert np.all(drogue.rim_radius_m - radii - drogue.marker_radius_m >= 0.01 - 1e-12)


@pytest.mark.parametrize(
    ("positions", "order"),
    [
        (even_ring(6, 0.27), 6),
        (even_ring(6, 0.27)[:-1], 1),
        ((*even_ring(3, 0.27), *(tuple(-v for v in point) for point in even_ring(3, 0.27))), 6),
        (((0.27, 0.0), (-0.27, 0.0), (0.0, 0.26), (0.0, -0.26)), 2),
        (((0.27, 0.0), (0.0, 0.27), (0.0, -0.27)), 1),
    ],
)
def test_symmetry_order(positions: tuple[tuple[float, float], ...], order: int) -> None:
    assert marker_layout(DrogueParameters(name="x", marker_positions_m=positions)).symmetry_order == order


@pytest.mark.parametrize("count", [5, 7, 8])
def test_a_ring_of_rounded_positions_is_the_ring_it_is_meant_to_be(count: int) -> None:
    rounded = tuple((round(x, 3), round(y, 3)) for x, y in even_ring(count, RING_RADIUS_M))
    layout = marker_layout(DrogueParameters(name="x", marker_positions_m=rounded))
    assert layout.symmetry_order == count
    # Rounding moves a marker by up to 0.71 mm.
    assert layout.ring_radius_m == pytest.approx(RING_RADIUS_M, abs=0.7e-3)
    # A marker that was meant to be elsewhere is.
    moved = (rounded[0], rounded[1], (rounded[2][0] + 0.004, rounded[2][1]), *rounded[3:])
    layout = marker_layout(DrogueParameters(name="x", marker_positions_m=moved))
    assert layout.symmetry_order == 1 and layout.ring_radius_m is None


@pytest.mark.parametrize(("name", "order"), [("basket-strut-markers", 6), ("cone-markers", 6)])
def test_symmetry_of_shipped_bodies(name: str, order: int) -> None:
    assert marker_layout(load_drogue(name)).symmetry_order == order


def test_symmetry_maps_the_markers_onto_themselves() -> None:
    for drogue in PRESETS.values():
        layout = marker_layout(drogue)
        angle = 2 * np.pi / layout.symmetry_order
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        turned = layout.centers_m @ turn.T
        np.testing.assert_allclose(turned, np.roll(layout.centers_m, -1, axis=0), rtol=0, atol=1e-15)


def test_markers_off_a_circle_have_no_ring_radius() -> None:
    layout = marker_layout(
        DrogueParameters(name="x", marker_positions_m=((0.27, 0.0), (-0.27, 0.0), (0.0, 0.26), (0.0, -0.26)))
    )
    assert layout.ring_radius_m is None


def test_hub_of_the_layout_is_the_drogue_s() -> None:
    layout = marker_layout(PRESETS["red-8"])
    assert layout.hub_center_m is not None and layout.hub_center_m.tolist() == [0.0, 0.0, 0.25]
    assert (layout.hub_inner_radius_m, layout.hub_outer_radius_m) == (0.05, 0.075)
    bare = marker_layout(DrogueParameters(name="x", marker_positions_m=even_ring(3, 0.27), hub=None))
    assert bare.hub_center_m is None
