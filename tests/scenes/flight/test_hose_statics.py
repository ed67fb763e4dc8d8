"""A hose at rest: balance of every link, agreement with the simulated chain, and its ends, length and place."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.sequence_ranges import HOSES, HoseParameters
from datasets_manifest.types.field_types import Range
from drogue_models.meshes import HOSE_SECTIONS, hose_mesh
from geometry.se3 import Array
from scenes.flight.towed_hose import (
    FITTED_LINKS,
    GRAVITY_M_S2,
    HOSE_LINKS,
    HoseAtRest,
    HoseEnds,
    HoseModel,
    bending_stiffness_n_m2,
    hose_at_rest,
    link_lengths_m,
)

FULL_SIZE = HOSES["full-size"]
AIRSPEEDS = Range(low=80, high=200)
CASES = [
    (length_m, drop_deg, elevation_deg)
    for length_m in (5.0, 12.0, 25.0)
    for drop_deg in (5.0, 12.0, 20.0)
    for elevation_deg in (-20.0, -8.0, 6.0)
]


def hung(length_m: float, drop_deg: float, elevation_deg: float) -> tuple[HoseParameters, HoseAtRest]:
    hose = FULL_SIZE.model_copy(update={"length_m": length_m})
    ends = HoseEnds(0.0, float(np.radians(elevation_deg)), float(np.radians(drop_deg)), float(np.radians(2.5)))
    return hose, hose_at_rest(hose, ends, AIRSPEEDS)


def angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def drag_n(hose: HoseParameters, link_m: Array, airspeed_m_s: float) -> Array:
    """Drag of one link by its vector, written out for the cross flow and the skin each."""
    length_m = np.linalg.norm(link_m)
    along = link_m / length_m
    wind = np.array([airspeed_m_s, 0.0, 0.0])
    friction, across = (wind @ along) * along, wind - (wind @ along) * along
    side_m2, skin_m2 = hose.diameter_m * length_m, np.pi * hose.diameter_m * length_m
    pressure = hose.crossflow_drag_coefficient * side_m2 * np.linalg.norm(across) * across
    skin = hose.skin_drag_coefficient * skin_m2 * np.linalg.norm(friction) * friction
    return hose.air_density_kg_m3 / 2 * (pressure + skin)


@pytest.mark.parametrize(("length_m", "drop_deg", "elevation_deg"), CASES)
def test_forces_and_moments_on_every_link_balance(length_m: float, drop_deg: float, elevation_deg: float) -> None:
    hose, rest = hung(length_m, drop_deg, elevation_deg)
    links = np.diff(rest.nodes_m, axis=0)
    lengths = np.linalg.norm(links, axis=1)
    weight = np.array([0.0, 0.0, -hose.mass_per_length_kg_m * GRAVITY_M_S2])
    loads = [drag_n(hose, link, rest.airspeed_m_s) + np.linalg.norm(link) * weight for link in links]
    # Forces at the joints, from the drogue upwards: each link passes on what pulls below it, and its own load.
    joints = [rest.pull_n]
    for load in reversed(loads):
        joints.append(joints[-1] + load)
    joints.reverse()
    directions = links / lengths[:, None]
    between = (lengths[1:] + lengths[:-1]) / 2
    bending = bending_stiffness_n_m2(hose.diameter_m) / between[:, None] * np.cross(directions[:-1], directions[1:])
    for index in range(FITTED_LINKS, HOSE_LINKS - FITTED_LINKS):
        turning = np.cross(links[index] / 2, joints[index + 1] + joints[index])
        left_over = turning + bending[index] - bending[index - 1]
        # A share of the moment that the tension would have on the link lying across it; rounding is 1e-10 of it.
        assert np.linalg.norm(left_over) < 1e-6 * lengths[index] * np.linalg.norm(rest.pull_n)


def test_air_and_weight_alone_give_the_simulated_hose_its_shape() -> None:
    simulated = HoseModel(FULL_SIZE, links=64).equilibrium().nodes_m[:, 0].T
    chord, last = simulated[-1], simulated[-1] - simulated[-2]
    ends = HoseEnds(
        float(np.arctan2(simulated[1, 2], simulated[1, 0])),
        float(np.arctan2(last[2], last[0])),
        float(np.arctan2(-chord[2], chord[0])),
        0.0,
    )
    rest = hose_at_rest(FULL_SIZE, ends, AIRSPEEDS)
    # Stiffness and other links than the simulation's change the needed speed by some tenths of a percent.
    assert rest.airspeed_m_s == pytest.approx(FULL_SIZE.airspeed_m_s, rel=0.01)
    assert rest.pull_n[1] == pytest.approx(0.0, abs=1e-6)
    assert rest.pull_n[2] == pytest.approx(-FULL_SIZE.drogue_mass_kg * GRAVITY_M_S2)
    places = [np.linalg.norm(simulated - node, axis=1).min() for node in rest.nodes_m]
    # The simulation's nodes are 0.23 m apart, so that a point between two is up to 0.12 m from one.
    assert max(places) < 0.13
    assert np.linalg.norm(rest.nodes_m[-1] - chord) < 0.01


@pytest.mark.parametrize(("length_m", "drop_deg", "elevation_deg"), CASES)
def test_the_hose_has_its_length_and_hangs_where_it_is_drawn(
    length_m: float, drop_deg: float, elevation_deg: float
) -> None:
    _, rest = hung(length_m, drop_deg, elevation_deg)
    assert np.linalg.norm(np.diff(rest.nodes_m, axis=0), axis=1).sum() == pytest.approx(length_m, rel=1e-9)
    end = rest.nodes_m[-1]
    assert np.degrees(np.arcsin(-end[2] / np.linalg.norm(end))) == pytest.approx(drop_deg, abs=1e-5)
    assert np.degrees(np.arctan2(end[1], end[0])) == pytest.approx(2.5, abs=1e-5)


@pytest.mark.parametrize(("length_m", "drop_deg", "elevation_deg"), CASES)
def test_the_drawn_tube_meets_exit_and_coupling_along_their_axes(
    length_m: float, drop_deg: float, elevation_deg: float
) -> None:
    _, rest = hung(length_m, drop_deg, elevation_deg)
    rings = np.asarray(hose_mesh(rest.nodes_m, 0.0335).vertices)[:-2].reshape(-1, HOSE_SECTIONS, 3)
    middles = rings.mean(axis=1)
    # The curve through the nodes is a little longer than their chords.
    assert np.linalg.norm(np.diff(middles, axis=0), axis=1).sum() == pytest.approx(length_m, rel=0.005)
    # The spline through the nodes is not clamped: the first bend turns its end by a degree at most.
    assert angle_deg(middles[1] - middles[0], np.array([1.0, 0.0, 0.0])) < 1.0
    entering = middles[-1] - middles[-2]
    assert np.degrees(np.arcsin(entering[2] / np.linalg.norm(entering))) == pytest.approx(elevation_deg, abs=1.0)


def test_a_drogue_that_hardly_pulls_is_refused_in_one_line() -> None:
    feather = FULL_SIZE.model_copy(update={"drogue_drag_coefficient": 1e-9, "crossflow_drag_coefficient": 0.0})
    with pytest.raises(ValueError, match=r"hose: no shape at rest is found for 15 m; raise airspeed_m_s"):
        hose_at_rest(feather, HoseEnds(0.0, 0.0, 0.1, 0.0), Range(low=10, high=10))


def test_links_are_short_at_the_ends_and_add_up() -> None:
    for length_m in (0.3, 5.0, 25.0, 40.0):
        lengths = link_lengths_m(length_m)
        assert lengths.sum() == pytest.approx(length_m)
        assert lengths.min() > 0
        assert lengths[0] == pytest.approx(lengths[-1])
        assert lengths[0] < 0.2
