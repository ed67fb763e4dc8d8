"""The clear sky by day: the model of Preetham et al.

Products over many directions use einsum, because BLAS rounds differently with another number of threads.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.sky.photometry import (
    REC709_FROM_XYZ,
    REC709_LUMINANCE,
    Radiance,
    direction_from_angles,
    hemisphere,
    luminance,
)

# Perez's function is singular at the horizon and undefined below it.
_LOWEST_COSINE = 1e-3
# The model's chromaticity turns pink towards the horizon, unlike any sky: it is kept nearly constant below 7 degrees.
_LOWEST_CHROMATIC_COSINE = 0.12
# Lowest turbidity that the model was fitted to, and scale height of the haze. [m]
_LEAST_TURBIDITY, _HAZE_SCALE_M = 1.9, 1500.0
# Above this x the sky is on the daylight locus; below it by the range, the model alone counts.
_GREEN_BEYOND_X, _GREEN_RANGE_X = 0.34, 0.08
# White is the sun outside the atmosphere, as for its beam: its chromaticity, about that of daylight of 5900 K, is
# adapted to that of D65 by the Bradford transform (Lam 1985).
_SUN_XYZ = np.array([0.3235 / 0.3395, 1.0, (1.0 - 0.3235 - 0.3395) / 0.3395])
_D65_XYZ = np.array([0.95047, 1.0, 1.08883])
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_ADAPTED_FROM_XYZ = REC709_FROM_XYZ @ (
    np.linalg.inv(_BRADFORD) @ np.diag((_BRADFORD @ _D65_XYZ) / (_BRADFORD @ _SUN_XYZ)) @ _BRADFORD
)

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


class DaylightSky:
    """Preetham's daylight model under the full sun.

    The model is one of the sky seen from the ground. Its brightness is used unchanged at altitude. Its colour is that
    of the haze above the camera, because haze turns the sky around a low sun orange.

    Args:
        turbidity: 1.9 to 10.
        sun_elevation_deg, sun_azimuth_deg: direction to the sun, which must be above the horizon. [deg]
        altitude_m: of the camera. [m]
    """

    def __init__(
        self, turbidity: float, sun_elevation_deg: float, sun_azimuth_deg: float, altitude_m: float = 0.0
    ) -> None:
        self._turbidity = turbidity
        haze = (turbidity - _LEAST_TURBIDITY) * np.exp(-altitude_m / _HAZE_SCALE_M)
        self._chromatic_turbidity = float(_LEAST_TURBIDITY + haze)
        self.sun_direction = direction_from_angles(sun_elevation_deg, sun_azimuth_deg)
        self._sun_zenith_rad = np.radians(90.0 - sun_elevation_deg)

    @cached_property
    def _zenith_xyy(self) -> tuple[float, float, float]:
        turbidity, sun = self._turbidity, self._sun_zenith_rad
        colored = self._chromatic_turbidity
        powers, sun_powers = np.array([colored**2, colored, 1.0]), np.array([sun**3, sun**2, sun, 1.0])
        chi = (4.0 / 9.0 - turbidity / 120.0) * (np.pi - 2.0 * sun)
        luminance_kcd_m2 = (4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192
        x, y = powers @ _ZENITH_X @ sun_powers, powers @ _ZENITH_Y @ sun_powers
        return float(x), float(y), float(max(luminance_kcd_m2, 0.05) * 1e3)

    @cached_property
    def level_illuminance_lux(self) -> float:
        """Illuminance of level ground by the sky alone. [lux]"""
        directions, weight = hemisphere(30)
        return float((luminance(self.radiance(directions)) * weight).sum())

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
        softened = np.hypot(cos_zenith, _LOWEST_CHROMATIC_COSINE)
        x, y, luminance = (
            self._relative(key, cosine, gamma, cos_gamma) * scale
            for key, cosine, scale in zip(("x", "y", "Y"), (softened, softened, cos_zenith), zenith, strict=True)
        )
        # Around a low sun the model is too green; measured skies keep to the daylight locus (CIE 15).
        locus = (2.870 - 3.0 * x) * x - 0.275
        y = locus + (y - locus) * np.clip((_GREEN_BEYOND_X - x) / _GREEN_RANGE_X, 0.0, 1.0)
        xyz = np.stack([x / y * luminance, luminance, (1.0 - x - y) / y * luminance], axis=-1)
        rgb = np.maximum(np.einsum("...j,ij->...i", xyz, _ADAPTED_FROM_XYZ), 0.0)
        # Adaptation changes the colour and must keep the luminance.
        rgb *= (luminance / np.einsum("...c,c->...", rgb, REC709_LUMINANCE))[..., None]
        result: Radiance = rgb.astype(np.float32)
        return result

    def _relative(
        self, key: str, cos_zenith: NDArray[np.float64], gamma: NDArray[np.float64], cos_gamma: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Perez's function, relative to its value at the zenith."""
        turbidity = self._turbidity if key == "Y" else self._chromatic_turbidity
        a, b, c, d, e = (slope * turbidity + offset for slope, offset in _PEREZ[key])
        value = (1 + a * np.exp(b / cos_zenith)) * (1 + c * np.exp(d * gamma) + e * cos_gamma**2)
        sun = self._sun_zenith_rad
        at_zenith = (1 + a * np.exp(b)) * (1 + c * np.exp(d * sun) + e * np.cos(sun) ** 2)
        result: NDArray[np.float64] = value / at_zenith
        return result
