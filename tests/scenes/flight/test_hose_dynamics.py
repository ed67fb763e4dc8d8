"""The hose against closed forms, conservation laws, and the numbers that its presets are known for."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.sequence_ranges import HOSES, Follower, HoseParameters
from scenes.flight import hose_step
from scenes.flight.airflow import GUST_PERIOD_S, dryden, sample_gusts
from scenes.flight.towed_hose import GRAVITY_M_S2, LINKS, TIME_STEP_S, HoseModel, HoseState
from scenes.flight.trajectory import SimulationInputs, simulate

FULL_SIZE = HOSES["full-size"]
VACUUM = FULL_SIZE.model_copy(update={"air_density_kg_m3": 1e-12})
STILL_AIR = FULL_SIZE.model_copy(update={"airspeed_m_s": 0.0})
POD = np.zeros((3, 1))


def stream(hose: HoseParameters) -> np.ndarray:
    air = np.zeros((3, 1, LINKS + 1))
    air[0] = hose.airspeed_m_s
    return air


def run(
    hose: HoseParameters, state: HoseState, seconds: float, step_s: float = TIME_STEP_S
) -> tuple[np.ndarray, np.ndarray]:
    """Drogue's places, and energy with velocities at the times of the places, step by step."""
    model, air, places, energies = HoseModel(hose), stream(hose), [], []
    for _ in range(round(seconds / step_s)):
        before = state.velocities_m_s.copy()
        at = HoseState(state.nodes_m.copy(), before, state.tensions_n)
        model.step(state, air, POD, step_s)
        at.velocities_m_s = (before + state.velocities_m_s) / 2
        places.append(at.nodes_m[:, 0, -1])
        energies.append(model.energy_j(at)[0])
    return np.array(places), np.array(energies)


def longest_error(nodes: np.ndarray, hose: HoseParameters) -> float:
    lengths = np.linalg.norm(np.diff(nodes, axis=-1), axis=-3)
    return np.abs(lengths * LINKS / hose.length_m - 1).max()


def turned_sideways(hose: HoseParameters, angle_deg: float) -> HoseState:
    """The equilibrium turned about the vertical through the pod: a swing that the air pulls back."""
    state, angle = HoseModel(hose).equilibrium(), np.radians(angle_deg)
    x, y = state.nodes_m[0].copy(), state.nodes_m[1].copy()
    state.nodes_m[0], state.nodes_m[1] = np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y
    return state


def with_a_kick(hose: HoseParameters, speed_m_s: float, at_rest_of: HoseParameters | None = None) -> HoseState:
    state = HoseModel(at_rest_of or hose).equilibrium()
    state.velocities_m_s[1, 0] = np.linspace(0, speed_m_s, LINKS + 1)
    return state


def zero_crossings_s(values: np.ndarray, step_s: float) -> np.ndarray:
    return np.flatnonzero(values[1:] * values[:-1] < 0) * step_s


def test_equilibrium_of_the_full_size_hose() -> None:
    aft, side, up = HoseModel(FULL_SIZE).equilibrium().nodes_m[:, 0, -1]
    # The project's acceptance values.
    assert aft == pytest.approx(14.2, abs=0.2) and -up == pytest.approx(4.9, abs=0.2) and side == 0


# So little drag that the wind on a link turns it further than the drogue holds it.
LIGHT = FULL_SIZE.model_copy(update={"drogue_diameter_m": 0.1, "drogue_mass_kg": 1.0})


@pytest.mark.parametrize("hose", [*HOSES.values(), LIGHT], ids=[*HOSES, "light drogue"])
def test_equilibrium_stays_at_rest(hose: HoseParameters) -> None:
    state = HoseModel(hose).equilibrium()
    begun = state.nodes_m.copy()
    run(hose, state, 2.0)
    # Rounding of forces of 1e3 N over masses of 1 kg, integrated twice over 2 s.
    np.testing.assert_allclose(state.nodes_m, begun, atol=1e-9)


def test_without_wind_the_hose_hangs_down() -> None:
    nodes = HoseModel(STILL_AIR).equilibrium().nodes_m[:, 0]
    np.testing.assert_allclose(nodes, [[0.0], [0.0], [-1.0]] * np.linspace(0, 15, LINKS + 1), atol=1e-12)


def test_free_lateral_period() -> None:
    places, _ = run(FULL_SIZE, turned_sideways(FULL_SIZE, 3.0), 16.5)
    crossings = zero_crossings_s(places[:, 1], TIME_STEP_S)
    # The project's acceptance value.
    assert 2 * np.diff(crossings).mean() == pytest.approx(3.9, abs=0.2)


def test_a_heavy_drogue_on_a_light_hose_is_a_pendulum() -> None:
    hose = VACUUM.model_copy(update={"mass_per_length_kg_m": 0.05, "airspeed_m_s": 0.0, "length_m": 4.0})
    places, _ = run(hose, with_a_kick(hose, 0.05), 20.0, step_s=0.001)
    period_s = 2 * np.diff(zero_crossings_s(places[1:, 1], 0.001)).mean()
    masses, down_m = HoseModel(hose).masses_kg, np.arange(1, LINKS + 1) / LINKS * 4.0
    closed_s = 2 * np.pi * np.sqrt((masses * down_m**2).sum() / (GRAVITY_M_S2 * (masses * down_m).sum()))
    # Crossings are read to one step of 1 ms over nine half periods of 2 s; the swing of 0.5 degrees adds 5e-6.
    assert period_s == pytest.approx(closed_s, rel=3e-4)


def test_energy_is_kept_in_vacuum() -> None:
    # A kick that whirls the whole hose about; its kinetic energy is the scale.
    swing = VACUUM.model_copy(update={"airspeed_m_s": 0.0})
    state = with_a_kick(swing, 6.0)
    kinetic_j = 0.5 * (HoseModel(swing).masses_kg * state.velocities_m_s[1, 0, 1:] ** 2).sum()
    _, energies = run(swing, state, 20.0)
    # A symplectic method of second order: 1e-5 of the scale at 2 ms was measured to fall fourfold with half the step.
    assert np.ptp(energies[1:]) < 1e-5 * kinetic_j


def test_energy_does_not_grow_without_wind() -> None:
    # From the slant of flight at 120 m/s, which in still air is a fall with whips.
    _, energies = run(STILL_AIR, with_a_kick(STILL_AIR, 3.0, at_rest_of=FULL_SIZE), 12.0)
    # A step may gain what a step loses to drag, never more: far below a millionth of the energy.
    assert np.diff(energies).max() < 1e-6 * np.abs(energies).max()
    assert energies[-1] < energies[0] - 1000


def gusty(severity: str, seconds: float, seed: int = 3, body_radius_m: float = 0.0) -> SimulationInputs:
    samples = round(seconds / GUST_PERIOD_S)
    gusts = sample_gusts(
        np.random.default_rng(seed), dryden(severity, FULL_SIZE.turbulence_altitude_m), 120.0, (samples, 1)
    )
    behind = np.tile(np.array([[2.5], [0.0], [-0.1]]), (samples, 1, 1))
    return SimulationInputs(
        gusts, lambda time: np.zeros((*time.shape, 3)), behind, np.zeros(3), body_radius_m, Follower()
    )


@pytest.mark.parametrize("case", ["severe", "fall"])
def test_links_keep_their_lengths(case: str) -> None:
    if case == "severe":
        nodes = simulate(FULL_SIZE, gusty("severe", 20.0)).nodes_m
    else:
        state, model = with_a_kick(STILL_AIR, 3.0, at_rest_of=FULL_SIZE), HoseModel(STILL_AIR)
        nodes = np.zeros((0, *state.nodes_m.shape))
        for _ in range(4000):
            model.step(state, stream(STILL_AIR), POD, TIME_STEP_S)
            nodes = np.concatenate([nodes[-1:], state.nodes_m[None]])
            assert longest_error(nodes, STILL_AIR) < 1e-4
    # The project's acceptance value; the method leaves 1e-6 in the wildest whip.
    assert longest_error(nodes, FULL_SIZE) < 1e-4


def test_half_the_time_step_gives_the_same_trajectory() -> None:
    around = gusty("moderate", 20.0, body_radius_m=0.5)
    coarse, fine = (simulate(FULL_SIZE, around, time_step_s=step_s).nodes_m[:, :, 0, -1] for step_s in (0.002, 0.001))
    # The project's acceptance value, against how far the drogue moves.
    assert np.linalg.norm(coarse - fine, axis=1).max() < 0.01 * np.ptp(coarse, axis=0).max()


def test_sequences_side_by_side_are_those_alone() -> None:
    around = gusty("moderate", 4.0)
    twice = SimulationInputs(
        np.repeat(around.gusts_m_s, 2, axis=2),
        around.pod_m,
        np.repeat(around.from_drogue_m, 2, axis=2),
        around.nose_source_m,
        0.5,
        around.follower,
    )
    alone = simulate(FULL_SIZE, gusty("moderate", 4.0, body_radius_m=0.5))
    both = simulate(FULL_SIZE, twice)
    for sequence in (0, 1):
        # Products in another order: rounding of places of 15 m, carried along for 2000 steps.
        np.testing.assert_allclose(both.nodes_m[:, :, sequence], alone.nodes_m[:, :, 0], atol=1e-9)
        np.testing.assert_allclose(both.eye_m[..., sequence], alone.eye_m[..., 0], atol=1e-9)


def test_a_released_hose_begins_where_it_is_let_go() -> None:
    place = np.array([9.0, 6.0, -5.0])
    nodes = simulate(FULL_SIZE, gusty("none", 0.1), release_m=place).nodes_m
    np.testing.assert_allclose(nodes[0, :, 0, -1], place, atol=1e-9)
    assert longest_error(nodes, FULL_SIZE) < 1e-4
    # It hangs through, and does not stand up.
    assert nodes[0, 2, 0, LINKS // 2] < place[2] / 2


def test_a_hose_that_does_not_reach_is_refused() -> None:
    with pytest.raises(ValueError, match=r"release_m: a hose of 15 m cannot hang .* 16 m away"):
        simulate(FULL_SIZE, gusty("none", 0.1), release_m=np.array([16.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"hose.mass_per_length_kg_m: .* make it heavier"):
        simulate(FULL_SIZE.model_copy(update={"mass_per_length_kg_m": 1e-3}), gusty("none", 0.1))
    thin = {"length_m": 100.0, "diameter_m": 0.01, "mass_per_length_kg_m": 0.0096, "drogue_mass_kg": 1e-6}
    with pytest.raises(ValueError, match=r"hose.drogue_mass_kg: .* make it heavier"):
        simulate(FULL_SIZE.model_copy(update=thin), gusty("none", 0.1))
    with pytest.raises(ValueError, match=r"time_step_s: must be a whole part of 0.02 s, got 0.003"):
        simulate(FULL_SIZE, gusty("none", 0.1), time_step_s=0.003)


@pytest.mark.slow
@pytest.mark.parametrize(("severity", "sd_m"), [("light", 0.30), ("moderate", 0.60), ("severe", 1.25)])
def test_drogue_swings_as_far_as_it_should(severity: str, sd_m: float) -> None:
    sequences, seconds, settling_s = 20, 130.0, 20.0
    samples = round(seconds / GUST_PERIOD_S)
    gusts = sample_gusts(
        np.random.default_rng(1), dryden(severity, FULL_SIZE.turbulence_altitude_m), 120.0, (samples, sequences)
    )
    around = SimulationInputs(
        gusts,
        lambda time: np.zeros((*time.shape, 3)),
        np.zeros((samples, 3, sequences)),
        np.zeros(3),
        0.0,
        Follower(bandwidth_hz=0),
    )
    # 4 ms is as good as 2 ms for a deviation that is known to percents.
    nodes = simulate(FULL_SIZE, around, time_step_s=0.004).nodes_m[round(settling_s / GUST_PERIOD_S) :]
    across = nodes[:, 1:, :, -1].std(axis=(0, 2))
    # The project's acceptance values, over 2200 s; sideways and vertical, for along the hose it can hardly move.
    np.testing.assert_allclose(across, sd_m, rtol=0.15)


def test_tensions_solve_their_system() -> None:
    """Against a general solver; the last system's rows must change places, as their diagonal is small."""
    rng = np.random.default_rng(3)
    for bent, scale in ((0.2, 1.0), (1.0, 1.0), (1.0, 0.05)):
        links = rng.normal(size=(3, 1)) + bent * rng.normal(size=(3, LINKS))
        u = links / np.linalg.norm(links, axis=0)
        ahead = scale * u + 0.3 * rng.normal(size=u.shape)
        inverse = rng.uniform(0.5, 2.0, LINKS)
        both = inverse + np.append(0.0, inverse[:-1])
        change = np.empty(LINKS)
        hose_step._restore_lengths(u, ahead, (1 / inverse, inverse, both), (1.0, 1.0, 0.1, 0.02), change)
        system = np.diag(both * (ahead * u).sum(axis=0))
        system += np.diag(-inverse[:-1] * (ahead[:, 1:] * u[:, :-1]).sum(axis=0), -1)
        system += np.diag(-inverse[:-1] * (ahead[:, :-1] * u[:, 1:]).sum(axis=0), 1)
        expected = np.linalg.solve(system, ((ahead**2).sum(axis=0) - 1.0) / 0.02)
        # Both eliminations round by a few units in the last place, which the condition number enlarges.
        tolerance = 10 * np.finfo(float).eps * np.linalg.cond(system) * np.abs(expected).max()
        np.testing.assert_allclose(change, expected, rtol=0, atol=tolerance)
