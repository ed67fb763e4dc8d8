"""The moving air around hose and receiver: Dryden turbulence.

Turbulence is a frozen field flown through at constant speed. Gusts are drawn on a time grid of their own by the exact
discretisation of the shaping filters, so that neither their spectrum nor their values depend on the time step of the
simulation that uses them. The scales are those of MIL-F-8785C and its spectra; the lateral and vertical scales of
MIL-HDBK-1797, which are half as long, belong to other formulas.

Source: MIL-F-8785C (1980), section 3.7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from datasets_manifest.types.environment import MIN_AIRSPEED_M_S, Turbulence
from geometry.compiled_loops import compiled
from geometry.se3 import Array

GUST_PERIOD_S = 0.02
_FOOT_M = 0.3048
_KNOT_M_S = 1852 / 3600
# Heights at which the low-altitude law ends and the one of free air begins. [ft]
_LOW_FT, _HIGH_FT = 1000.0, 2000.0
_HIGH_SCALE_FT = 1750.0
_LOWEST_FT = 10.0
# Wind at 20 ft above ground, and standard deviation in free air, of light, moderate and severe turbulence.
_WIND_AT_20_FT_M_S = {"light": 15 * _KNOT_M_S, "moderate": 30 * _KNOT_M_S, "severe": 45 * _KNOT_M_S}
_FREE_AIR_M_S = {"light": 5 * _FOOT_M, "moderate": 10 * _FOOT_M, "severe": 20 * _FOOT_M}


@dataclass(frozen=True)
class Dryden:
    """Standard deviations and scales of gusts along, across (sideways) and vertical to the flight.

    Attributes:
        sd_m_s: (u, v, w). [m/s]
        scale_m: (u, v, w). [m]
    """

    sd_m_s: tuple[float, float, float]
    scale_m: tuple[float, float, float]


def dryden(severity: Turbulence, altitude_m: float) -> Dryden:
    """Turbulence of a severity at an altitude above ground.

    The low-altitude law below 1000 ft, that of free air above 2000 ft, and linear interpolation in between.
    """
    height_ft = max(altitude_m / _FOOT_M, _LOWEST_FT)
    if severity == "none":
        return Dryden((0.0, 0.0, 0.0), (_HIGH_SCALE_FT * _FOOT_M,) * 3)
    low = _low_altitude(severity, min(height_ft, _LOW_FT))
    high = np.array([[_FREE_AIR_M_S[severity]] * 3, [_HIGH_SCALE_FT * _FOOT_M] * 3])
    share = float(np.clip((height_ft - _LOW_FT) / (_HIGH_FT - _LOW_FT), 0.0, 1.0))
    sd, scale = (1 - share) * low + share * high
    return Dryden((sd[0], sd[1], sd[2]), (scale[0], scale[1], scale[2]))


def _low_altitude(severity: Turbulence, height_ft: float) -> Array:
    """(2, 3) standard deviations [m/s] and scales [m]; the constants are for heights in feet."""
    shape = 0.177 + 0.000823 * height_ft
    vertical = 0.1 * _WIND_AT_20_FT_M_S[severity]
    level = vertical / shape**0.4
    long_ft = height_ft / shape**1.2
    return np.array([[level, level, vertical], np.array([long_ft, long_ft, height_ft]) * _FOOT_M])


def sample_gusts(rng: np.random.Generator, turbulence: Dryden, airspeed_m_s: float, shape: tuple[int, int]) -> Array:
    """Gusts at a fixed point of the formation, stationary from the first sample on.

    Args:
        rng: draws them.
        turbulence: standard deviations and scales.
        airspeed_m_s: speed through the field. [m/s]
        shape: (T, S) samples, `GUST_PERIOD_S` apart, of S independent sequences.

    Returns:
        (T, 3, S) gusts along (u), across (v) and vertical to the flight (w). [m/s]

    Raises:
        ValueError: the airspeed is too low for a frozen field of turbulence.
    """
    if not any(turbulence.sd_m_s):
        return np.zeros((shape[0], 3, shape[1]))
    if airspeed_m_s < MIN_AIRSPEED_M_S:
        raise ValueError(
            f"turbulence: needs an airspeed of at least {MIN_AIRSPEED_M_S:g} m/s, got {airspeed_m_s:g}; use 'none'"
        )
    noise = rng.standard_normal((5, *shape))
    periods = [GUST_PERIOD_S * airspeed_m_s / scale for scale in turbulence.scale_m]
    sd = turbulence.sd_m_s
    along = sd[0] * _first_order(noise[0], periods[0])
    sideways, vertical = (
        sd[axis] * _second_order(noise[2 * axis - 1 : 2 * axis + 1], periods[axis]) for axis in (1, 2)
    )
    return np.stack([along, sideways, vertical], axis=1)


def _first_order(noise: Array, period: float) -> Array:
    """(T, S) unit-variance process of H(s) ~ 1 / (1 + s), sampled every `period` of its time constant."""
    keep, renew = np.exp(-period), np.sqrt(-np.expm1(-2 * period))
    out = np.empty_like(noise)
    out[0] = noise[0]
    for k in range(1, len(noise)):
        out[k] = keep * out[k - 1] + renew * noise[k]
    return out


def _second_order(noise: Array, period: float) -> Array:
    """(T, S) unit-variance process of H(s) ~ (1 + sqrt(3) s) / (1 + s)^2, from (2, T, S) noise.

    Its state (x, dx/dt), scaled to the covariance 1, moves by exp(A t) with A = ((0, 1), (-1, -2)).
    """
    advance = np.exp(-period) * np.array([[1 + period, period], [-period, 1 - period]])
    renew = np.linalg.cholesky(np.eye(2) - advance @ advance.T)
    out = np.empty(noise.shape[1:])
    _move_states(noise, advance, renew, out)
    return out


@compiled
def _move_states(noise: Array, advance: Array, renew: Array, out: Array) -> None:
    """Fill in (T, S) processes of `_second_order`, whose states move by two (2, 2) matrices."""
    for sequence in range(out.shape[1]):
        x, rate = noise[0, 0, sequence], noise[1, 0, sequence]
        for k in range(out.shape[0]):
            if k:
                first, second = noise[0, k, sequence], noise[1, k, sequence]
                x, rate = (
                    advance[0, 0] * x + advance[0, 1] * rate + renew[0, 0] * first,
                    advance[1, 0] * x + advance[1, 1] * rate + renew[1, 0] * first + renew[1, 1] * second,
                )
            out[k, sequence] = (x + np.sqrt(3.0) * rate) / 2


def spectrum(turbulence: Dryden, airspeed_m_s: float, angular_rate_rad_s: ArrayLike) -> Array:
    """One-sided power spectral densities of the gusts along, across and vertical to the flight.

    Args:
        turbulence: standard deviations and scales.
        airspeed_m_s: [m/s]
        angular_rate_rad_s: (M,) angular frequencies. [rad/s]

    Returns:
        (3, M) densities, whose integrals over the angular frequency are the variances. [m2/s2/(rad/s)]

    Source: MIL-F-8785C, section 3.7.1.2.
    """
    rate = np.asarray(angular_rate_rad_s, dtype=np.float64)
    densities = []
    for axis, (sd, scale) in enumerate(zip(turbulence.sd_m_s, turbulence.scale_m, strict=True)):
        lag = scale / airspeed_m_s
        x2 = (lag * rate) ** 2
        if axis == 0:
            densities.append(sd**2 * 2 * lag / np.pi / (1 + x2))
        else:
            densities.append(sd**2 * lag / np.pi * (1 + 3 * x2) / (1 + x2) ** 2)
    return np.stack(densities)
