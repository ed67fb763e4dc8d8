"""A receiver's approaches and manoeuvres, and the follower that guides it to the drogue."""

from __future__ import annotations

import numpy as np
import pytest

from datasets_manifest.recipe.sequence_ranges import CLOSURE_ACCELERATION_M_S2, Follower, Receiver
from scenes.flight.trajectory import Guidance, closure_distance_m, desired_offsets_m


def test_a_run_keeps_speed_and_acceleration() -> None:
    time_s = np.linspace(-1, 30, 31001)
    way = closure_distance_m(time_s, 8.3, 0.6)
    speed, acceleration = np.gradient(way, time_s), np.gradient(np.gradient(way, time_s), time_s)
    assert way[0] == 0 and way[-1] == pytest.approx(8.3)
    assert speed.max() == pytest.approx(0.6, abs=1e-6) and speed.min() > -1e-9
    assert np.abs(acceleration).max() < CLOSURE_ACCELERATION_M_S2 * 1.001
    # Too short to get up to speed: a triangle.
    assert np.gradient(closure_distance_m(time_s, 0.1, 0.6), time_s).max() == pytest.approx(
        np.sqrt(0.1 * 0.5), rel=1e-2
    )


def test_manoeuvres() -> None:
    receiver, time_s = Receiver(start_m=10, end_m=2, abort_m=3), np.linspace(0, 60, 601)
    docking, station, missed = (
        desired_offsets_m(receiver, manoeuvre, (0.5, -0.2), time_s)
        for manoeuvre in ("docking", "station", "missed-approach")
    )
    np.testing.assert_allclose(docking[0], [0.5, -0.2, 10])
    np.testing.assert_allclose(docking[-1], [0, 0, 2], atol=1e-12)
    np.testing.assert_allclose(station, np.broadcast_to([0.5, -0.2, 10], station.shape))
    assert missed[:, 2].min() == pytest.approx(3, abs=0.01) and missed[-1, 2] == pytest.approx(10)
    np.testing.assert_allclose(missed[:, :2], station[:, :2])


def follow(follower: Follower, drogue: np.ndarray, period_s: float = 0.02) -> np.ndarray:
    guidance, places = Guidance(follower, period_s, np.zeros((3, 1))), []
    for place in drogue:
        places.append(guidance.position_m[0, 0])
        guidance.steer(np.array([[place], [0.0], [0.0]]), np.zeros((3, 1)), np.zeros((3, 1)))
        guidance.move()
    return np.array(places)


def test_a_follower_has_the_bandwidth_that_is_stated() -> None:
    time_s = 0.02 * np.arange(6000)
    follower = Follower(bandwidth_hz=0.5, delay_s=0.0, acceleration_limit_m_s2=100)
    for hertz in (0.1, 0.5):
        drogue = np.sin(2 * np.pi * hertz * time_s)
        error = (follow(follower, drogue) - drogue)[3000:]
        s = 1j * hertz / 0.5
        # e/d = -s^2 / (s^2 + 2 zeta s + 1); a sample of 0.02 s is 4 % of a radian at 0.5 Hz and adds to it.
        assert np.abs(error).max() == pytest.approx(abs(s**2 / (s**2 + 1.6 * s + 1)), rel=0.12)


def test_a_follower_keeps_its_limit_and_knows_only_the_past() -> None:
    step = np.ones(400)
    slow = follow(Follower(bandwidth_hz=1.0, delay_s=0.0, acceleration_limit_m_s2=0.5), step)
    # Differences of places, of which each piece is a parabola.
    assert np.abs(np.diff(slow, 2)).max() <= 0.5 * 0.02**2 * (1 + 1e-9)
    late = follow(Follower(bandwidth_hz=1.0, delay_s=0.4), np.where(np.arange(400) < 50, 0.0, 1.0))
    # 0.4 s are 20 samples, and a sample is acted on in the next.
    assert np.abs(late[:71]).max() == 0 and late[75] > 0


def test_a_follower_at_its_limit_does_not_swing_past() -> None:
    # 8 m at 1 m/s2: its law of second order alone would go 5.7 m too far.
    way = follow(Follower(bandwidth_hz=0.8, delay_s=0.0, acceleration_limit_m_s2=1.0), np.full(1500, 8.0))
    # The overshoot of the law itself is 1.5 %, of what is left when it takes over.
    assert way[-1] == pytest.approx(8.0, abs=1e-3) and way.max() < 8.0 * 1.015
