"""The clear sky and the sun in absolute units, as a function of direction.

Products over many directions are written with einsum: BLAS would round differently with another number of threads.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.frame import Environment

Radiance = NDArray[np.float32]

REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_REC709_FROM_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)
SOLAR_ILLUMINANCE_LUX = 127_500.0  # outside the atmosphere, IES Lighting Handbook, 9th ed., ch. 8
SUN_RADIUS_RAD = np.radians(0.2666)
SUN_SOLID_ANGLE_SR = 2 * np.pi * (1 - np.cos(SUN_RADIUS_RAD))
_CHANNEL_WAVELENGTH_UM = np.array([0.610, 0.550, 0.465])  # centroids of the Rec. 709 primaries' bands
# Perez's function is singular at the horizon and undefined below it.
_LOWEST_COSINE = 1e-3
# Preetham's chromaticity turns pink towards the horizon, which no sky does; below 7 degrees its value there is held.
_LOWEST_CHROMATIC_COSINE = 0.12

# Preetham, Shirley, Smits 1999 (doi:10.1145/311535.311545), appendix A.2: distribution coefficients A..E against
# turbidity (slope, offset) for luminance Y and chromaticities x, y.
_PEREZ = {
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}
# The same appendix: zenith chromaticity as [T^2 T 1] M [s^3 s^2 s 1], s the sun's zenith angle.
_ZENITH_X = np.array(
    [[0.00166, -0.00375, 0.00209, 0.0], [-0.02903, 0.06377, -0.03202, 0.00394], [0.11693, -0.21196, 0.06052, 0.25886]]
)
_ZENITH_Y = np.array(
    [[0.00275, -0.00610, 0.00317, 0.0], [-0.04214, 0.08970, -0.04153, 0.00516], [0.15346, -0.26756, 0.06670, 0.26688]]
)


def direction_from_angles(elevation_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    """(3,) unit vector in world axes; azimuth from east towards north."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], dtype=np.float64
    )


class ClearSky:
    """Preetham's daylight model with the sun attenuated along its air mass.

    The model is one of the sky seen from the ground; it is used at altitude unchanged.
    """

    def __init__(self, environment: Environment) -> None:
        self._turbidity = environment.turbidity
        self.sun_direction = direction_from_angles(environment.sun_elevation_deg, environment.sun_azimuth_deg)
        self._sun_zenith_rad = np.radians(90.0 - environment.sun_elevation_deg)

    @cached_property
    def sun_illuminance_lux(self) -> NDArray[np.float64]:
        """(3,) illuminance of a plane that faces the sun, by channel. [lux]

        Source: Preetham et al. 1999, appendix A.1: Rayleigh and aerosol extinction; air mass of Kasten 1966.
        """
        zenith_deg = np.degrees(self._sun_zenith_rad)
        air_mass = 1.0 / (np.cos(self._sun_zenith_rad) + 0.15 * (93.885 - zenith_deg) ** -1.253)
        aerosol = 0.04608 * self._turbidity - 0.04586
        depth = 0.008735 * _CHANNEL_WAVELENGTH_UM**-4.08 + aerosol * _CHANNEL_WAVELENGTH_UM**-1.3
        result: NDArray[np.float64] = SOLAR_ILLUMINANCE_LUX * np.exp(-depth * air_mass)
        return result

    @cached_property
    def _zenith_xyy(self) -> tuple[float, float, float]:
        turbidity, sun = self._turbidity, self._sun_zenith_rad
        powers, sun_powers = np.array([turbidity**2, turbidity, 1.0]), np.array([sun**3, sun**2, sun, 1.0])
        chi = (4.0 / 9.0 - turbidity / 120.0) * (np.pi - 2.0 * sun)
        luminance_kcd_m2 = (4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192
        x, y = powers @ _ZENITH_X @ sun_powers, powers @ _ZENITH_Y @ sun_powers
        return float(x), float(y), float(max(luminance_kcd_m2, 0.05) * 1e3)

    def radiance(self, directions: NDArray[np.floating[Any]]) -> Radiance:
        """Radiance of the sky without the sun's disc.

        Args:
            directions: (..., 3) unit vectors in world axes; those below the horizon get the horizon's radiance.

        Returns:
            (..., 3) luminance-scaled linear Rec. 709. [cd/m2]
        """
        d = np.asarray(directions, dtype=np.float64)
        cos_zenith = np.maximum(d[..., 2], _LOWEST_COSINE)
        cos_gamma = np.clip(np.einsum("...i,i->...", d, self.sun_direction), -1.0, 1.0)
        gamma = np.arccos(cos_gamma)
        zenith = self._zenith_xyy
        x, y, luminance = (
            self._relative(key, np.maximum(cos_zenith, lowest), gamma, cos_gamma) * scale
            for key, lowest, scale in zip(
                ("x", "y", "Y"), (_LOWEST_CHROMATIC_COSINE, _LOWEST_CHROMATIC_COSINE, 0.0), zenith, strict=True
            )
        )
        xyz = np.stack([x / y * luminance, luminance, (1.0 - x - y) / y * luminance], axis=-1)
        result: Radiance = np.maximum(np.einsum("...j,ij->...i", xyz, _REC709_FROM_XYZ), 0.0).astype(np.float32)
        return result

    def _relative(
        self, key: str, cos_zenith: NDArray[np.float64], gamma: NDArray[np.float64], cos_gamma: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Perez's function over its value at the zenith."""
        a, b, c, d, e = (slope * self._turbidity + offset for slope, offset in _PEREZ[key])
        value = (1 + a * np.exp(b / cos_zenith)) * (1 + c * np.exp(d * gamma) + e * cos_gamma**2)
        sun = self._sun_zenith_rad
        at_zenith = (1 + a * np.exp(b)) * (1 + c * np.exp(d * sun) + e * np.cos(sun) ** 2)
        result: NDArray[np.float64] = value / at_zenith
        return result

    def add_sun_disc(self, radiance: Radiance, directions: NDArray[np.float32]) -> None:
        """Add the sun's disc, in place, to (..., 3) radiance seen along (..., 3) unit directions."""
        cosine = np.einsum("...i,i->...", directions, self.sun_direction.astype(np.float32))
        disc = cosine > np.cos(SUN_RADIUS_RAD)
        if disc.any():
            radiance[disc] += (self.sun_illuminance_lux / SUN_SOLID_ANGLE_SR).astype(np.float32)
