"""The air that a nose pushes ahead of itself, and how far it pushes a drogue aside."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.sequence_ranges import Follower, HoseParameters, Receiver, SequenceRanges
from scenes.flight.airflow import GUST_PERIOD_S
from scenes.flight.hose_step import air_at_nodes
from scenes.flight.trajectory import SimulationInputs, simulate


def air_m_s(place_m: tuple[float, float, float], radius_m: float) -> np.ndarray:
    """(3,) velocity of the air at a place about a source at the origin, where 120 m/s come from ahead of the nose."""
    air = np.empty((3, 1, 1))
    bow = (120.0 * radius_m**2 / 4, (radius_m / 2) ** 2)
    air_at_nodes(np.array(place_m).reshape(3, 1, 1), np.zeros((3, 1)), 120.0, np.zeros((3, 1)), bow, air)
    return air[:, 0, 0]


def test_bow_wave_of_a_half_body() -> None:
    # V a^2 / 4 r^2 by hand: 120 x 0.25 / 4 / 0.81 = 9.26 m/s, straight away from the source.
    np.testing.assert_allclose(air_m_s((0.9, 0.0, 0.0), 0.5), [129.259, 0, 0], atol=1e-3)
    # The stream comes to rest at the tip, half a radius ahead.
    np.testing.assert_allclose(air_m_s((-0.25, 0.0, 0.0), 0.5), 0.0, atol=1e-12)
    assert air_m_s((-0.25, 0.0, 0.0), 0.0).tolist() == [120.0, 0.0, 0.0]


@pytest.mark.parametrize(("radius_m", "beside_and_behind_m", "abeam_m"), [(0.5, 0.19, 0.34), (0.15, 0.02, 0.05)])
def test_a_nose_pushes_the_drogue_away(radius_m: float, beside_and_behind_m: float, abeam_m: float) -> None:
    """A nose 0.9 m to the left of the hanging drogue: as far behind it, as that of a receiver, or level with it."""
    hose = SequenceRanges(frames_per_sequence=1, receiver=Receiver(manoeuvres=("station",))).hose
    samples = round(18 / GUST_PERIOD_S)
    # Comes in from the side within eight seconds, so that the hose hardly swings.
    inwards_m = 8 * np.clip(1 - np.arange(samples) * GUST_PERIOD_S / 8, 0, 1)
    for behind_m, pushed_m in ((0.9, beside_and_behind_m), (0.0, abeam_m)):
        way = simulate_beside(hose, radius_m, inwards_m, np.array([behind_m, -0.9, 0.0]))
        # Mean over a period of the free swing, from where the drogue hangs. Pushes are known to the centimetre.
        assert (way[-round(3.9 / GUST_PERIOD_S) :, 1] - way[0, 1]).mean() == pytest.approx(pushed_m, abs=0.008)


def simulate_beside(hose: HoseParameters, radius_m: float, inwards_m: np.ndarray, source_m: np.ndarray) -> np.ndarray:
    """(T, 3) way of a drogue beside a source that comes in from the left to its place about the hanging drogue."""
    from_drogue = np.zeros((len(inwards_m), 3, 1))
    from_drogue[:, 1, 0] = -inwards_m
    around = SimulationInputs(
        gusts_m_s=np.zeros_like(from_drogue),
        pod_m=lambda times: np.zeros((len(times), 3)),
        from_drogue_m=from_drogue,
        nose_source_m=source_m,
        body_radius_m=radius_m,
        follower=Follower(bandwidth_hz=0),
    )
    return simulate(hose, around).nodes_m[:, :, 0, -1]
