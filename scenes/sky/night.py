"""The night sky: airglow and starlight, the moon, and bright stars."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.random_streams import frame_generator
from datasets_manifest.types.environment import Moon
from scenes.sky.photometry import Radiance

# Dark sites: 21.9 mag/arcsec2 at the zenith, 1.9e-4 cd/m2 (Leinert et al. 1998, doi:10.1051/aas:1998105), with the
# brighter stars, which the background of telescopes excludes, 2.6e-4.
_ZENITH_CD_M2 = 2.6e-4
_AIRGLOW_SHARE, _AIRGLOW_HEIGHT_M, _EARTH_M = 0.6, 9e4, 6.371e6
EXTINCTION_MAG = 0.17
_NIGHT_RGB = np.array([1.02, 1.0, 0.95], dtype=np.float32)
# A star of magnitude m gives 10^(-0.4 (m + 14.18)) lux (Allen's Astrophysical Quantities, 4th ed., sec. 2.6).
_LUX_ZERO_MAGNITUDE = 14.18
_FULL_MOON_MAGNITUDE = -12.73
# Number of stars brighter than magnitude m in the whole sky: 10^(0.5 m + 0.70) (ibid., sec. 19.2, for m 1 to 6).
_FAINTEST_MAGNITUDE = 6.0
_STAR_SEED = 20


def night_radiance(directions: NDArray[np.floating[Any]]) -> Radiance:
    """Airglow and starlight without a moon. [cd/m2]

    Args:
        directions: (..., 3) unit vectors in world axes; those below the horizon get the horizon's radiance.
    """
    up = np.clip(np.asarray(directions[..., 2], dtype=np.float32), 0.0, 1.0)
    shell = np.float32((_EARTH_M / (_EARTH_M + _AIRGLOW_HEIGHT_M)) ** 2)
    longer = 1.0 / np.sqrt(1.0 - shell * (1.0 - up * up))
    air_mass = 1.0 / (up + 0.025 * np.exp(-11.0 * up))  # Rozenberg 1966
    left = np.float32(10.0) ** (-0.4 * EXTINCTION_MAG * (air_mass - 1.0))
    level = (_AIRGLOW_SHARE * longer + (1.0 - _AIRGLOW_SHARE)) * left + 0.35 * (1.0 - left)
    result: Radiance = (np.float32(_ZENITH_CD_M2) * level)[..., None].astype(np.float32) * _NIGHT_RGB
    return result


def moon_illuminance_lux(phase_angle_deg: float) -> float:
    """Illuminance by the moon outside the atmosphere at its mean distance. [lux]

    Source: Krisciunas and Schaefer 1991 (doi:10.1086/132921), equation 9.
    """
    magnitude = _FULL_MOON_MAGNITUDE + 0.026 * phase_angle_deg + 4e-9 * phase_angle_deg**4
    return float(10.0 ** (-0.4 * (magnitude + _LUX_ZERO_MAGNITUDE)))


def lit_side_of_moon(moon: Moon, across: NDArray[np.float32], away_from_sun: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points of the moon's disc are lit.

    Args:
        moon: gives the phase.
        across, away_from_sun: coordinates on the disc in radii; the second axis points away from the sun.
    """
    depth = np.sqrt(np.maximum(1.0 - across**2 - away_from_sun**2, 0.0))
    phase = np.radians(moon.phase_angle_deg)
    lit: NDArray[np.bool_] = depth * np.cos(phase) - away_from_sun * np.sin(phase) > 0
    return lit


@lru_cache(maxsize=1)
def star_catalogue() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (S, 3) and illuminance (S,) [lux] of random stars to magnitude 6, in their true number.

    Fainter stars are part of `night_radiance`.
    """
    rng = frame_generator(_STAR_SEED, 0, "stars")
    count = round(10 ** (0.5 * _FAINTEST_MAGNITUDE + 0.70))
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The inverse of the law of numbers at uniform ranks.
    magnitude = (np.log10(np.maximum(rng.random(count), 1e-4) * count) - 0.70) / 0.5
    return directions, 10.0 ** (-0.4 * (magnitude + _LUX_ZERO_MAGNITUDE))
