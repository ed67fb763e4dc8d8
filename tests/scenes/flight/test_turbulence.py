"""Turbulence against the standard's numbers and spectra."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import welch

from scenes.flight.airflow import GUST_PERIOD_S, Dryden, dryden, sample_gusts, spectrum

AIR = Dryden((1.0, 2.0, 0.5), (180.0, 100.0, 40.0))
SPEED_M_S = 120.0


def test_free_air() -> None:
    air = dryden("moderate", 6900.0)
    # MIL-F-8785C above 2000 ft: 1750 ft for all axes; moderate is 10 ft/s here.
    assert air.scale_m == pytest.approx((1750 * 0.3048,) * 3) and air.sd_m_s == pytest.approx((3.048,) * 3)


def test_low_altitude_at_200_ft() -> None:
    air = dryden("light", 200 * 0.3048)
    # By hand: 0.177 + 0.000823 x 200 = 0.3416; L = 200 / 0.3416^1.2 = 725.7 ft; sigma = 1.5 kt / 0.3416^0.4 = 2.305 kt.
    assert air.scale_m == pytest.approx((725.7 * 0.3048, 725.7 * 0.3048, 200 * 0.3048), rel=1e-3)
    assert air.sd_m_s == pytest.approx((2.305 * 0.51444, 2.305 * 0.51444, 1.5 * 0.51444), rel=1e-3)


def test_laws_meet() -> None:
    # At 1000 ft all scales are 1000 ft, as the standard has it.
    assert dryden("light", 304.8).scale_m == pytest.approx((304.8,) * 3, rel=1e-3)
    for height_m in (304.8, 609.6):
        below, above = (dryden("severe", height_m + step) for step in (-1e-6, 1e-6))
        np.testing.assert_allclose(below.sd_m_s, above.sd_m_s, rtol=1e-6)
        np.testing.assert_allclose(below.scale_m, above.scale_m, rtol=1e-6)


def test_analytic_spectra_integrate_to_the_variances() -> None:
    for axis, sd in enumerate(AIR.sd_m_s):
        # In the logarithm of the frequency, over all that matters; the ends hold 1e-3 of it.
        total, _ = quad(
            lambda log_rate, axis=axis: spectrum(AIR, SPEED_M_S, [np.exp(log_rate)])[axis, 0] * np.exp(log_rate),
            np.log(1e-5),
            np.log(1e4),
            limit=200,
        )
        assert total == pytest.approx(sd**2, rel=2e-3)


def test_gusts_have_the_analytic_spectra() -> None:
    samples, sequences = round(400 / GUST_PERIOD_S), 240
    gusts = sample_gusts(np.random.default_rng(2), AIR, SPEED_M_S, (samples, sequences))
    hertz, density = welch(gusts, 1 / GUST_PERIOD_S, nperseg=samples, axis=0, detrend=False)
    rate = 2 * np.pi * hertz
    for low, high in pairwise(np.geomspace(0.3, 30.0, 13)):
        band = (rate >= low) & (rate < high)
        found = density[band].mean(axis=(0, 2)) / (2 * np.pi)
        wanted = spectrum(AIR, SPEED_M_S, rate[band]).mean(axis=1)
        # The project's acceptance value, over two decades; the narrowest band has 6 x 240 estimates, 2.6 % of scatter.
        np.testing.assert_allclose(found, wanted, rtol=0.10)


def test_gusts_are_stationary_from_the_first() -> None:
    gusts = sample_gusts(np.random.default_rng(5), AIR, SPEED_M_S, (200, 4000))
    for at in (0, 199):
        # Standard error of a deviation from 4000 draws is 1.1 %; four of them.
        np.testing.assert_allclose(gusts[at].std(axis=1), AIR.sd_m_s, rtol=0.045)


def test_calm_air_is_calm() -> None:
    assert not sample_gusts(np.random.default_rng(0), dryden("none", 1000.0), 0.0, (10, 1)).any()


def test_a_frozen_field_must_be_flown_through() -> None:
    with pytest.raises(ValueError, match="turbulence: needs an airspeed of at least 5 m/s, got 0; use 'none'"):
        sample_gusts(np.random.default_rng(0), AIR, 0.0, (10, 1))
