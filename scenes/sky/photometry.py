"""Photometry that all light sources share: colour, luminance, directions, and the sun's beam through the air."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Radiance = NDArray[np.float32]

REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
REC709_FROM_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)
CHANNEL_WAVELENGTH_UM = np.array([0.610, 0.550, 0.465])  # centroids of the Rec. 709 primaries' bands
SOLAR_ILLUMINANCE_LUX = 127_500.0  # outside the atmosphere, IES Lighting Handbook, 9th ed., ch. 8
_MOLECULES_EXPONENT = 4.08  # of the wavelength, in the depth of air's molecules by Preetham et al. 1999
# Plants reflect several times as much in the near infrared: by how much they are greener than red and blue.
_GREENNESS = 4.0
SUN_RADIUS_RAD = np.radians(0.2666)
SUN_SOLID_ANGLE_SR = 2 * np.pi * (1 - np.cos(SUN_RADIUS_RAD))
# Refraction lifts sun and moon by about half a degree at the horizon (Bennett 1982, at 0 degrees).
_REFRACTION_AT_HORIZON_DEG = 0.57


def direction_from_angles(elevation_deg: float, azimuth_deg: float) -> NDArray[np.float64]:
    """(3,) unit vector in world axes; azimuth from east towards north."""
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    return np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], dtype=np.float64
    )


def luminance(radiance: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """(...) luminance of (..., 3) radiance. [cd/m2]"""
    result: NDArray[np.float64] = np.einsum("...c,c->...", np.asarray(radiance, dtype=np.float64), REC709_LUMINANCE)
    return result


def infrared_weights(band_nm: float) -> NDArray[np.float64]:
    """(3,) weights of red, green and blue that extrapolate light to a band beyond red, relative to sunlight there.

    Linear, so that mixtures stay mixtures, and exact for what is white in sunlight and for light that molecules have
    scattered once, whose share of sunlight falls by Rayleigh's law. Light that haze has scattered comes out up to a
    third too bright.

    Args:
        band_nm: middle of the band. [nm]
    """
    red, _, blue = (1e3 * CHANNEL_WAVELENGTH_UM / band_nm) ** -_MOLECULES_EXPONENT
    of_blue = (1.0 - red) / (blue - red)
    return np.array([1.0 - of_blue, 0.0, of_blue])


def infrared_light(rgb: NDArray[np.floating[Any]], band_nm: float) -> NDArray[Any]:
    """(...) light in a band beyond red of (..., 3) light, in units of sunlight, which is as bright there as elsewhere.

    Nothing falls more steeply from green on than light that molecules scatter, and plants, which alone are greener than
    red and blue, are several times as bright.

    Args:
        rgb: linear Rec. 709. [cd/m2]
        band_nm: middle of the band. [nm]
    """
    weights = infrared_weights(band_nm).astype(rgb.dtype)
    least = rgb.dtype.type((1e-3 * band_nm / CHANNEL_WAVELENGTH_UM[1]) ** -_MOLECULES_EXPONENT)
    red, green, blue = (rgb[..., channel] for channel in range(3))
    greener = rgb.dtype.type(_GREENNESS) * np.maximum(green - np.maximum(red, blue), 0)
    light: NDArray[Any] = np.maximum(weights[0] * red + weights[2] * blue, least * green) + greener
    return light


def light_in_band(rgb: NDArray[np.floating[Any]], band_nm: float | None) -> NDArray[Any]:
    """(...) luminance of (..., 3) light, or `infrared_light` where a band is given. [cd/m2]"""
    return luminance(rgb) if band_nm is None else infrared_light(rgb, band_nm)


def hemisphere(rows: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions that cover the upper hemisphere.

    Returns:
        (rows, 4 rows, 3) unit vectors, and (rows, 4 rows) weights that convert radiance to illuminance of level ground.
    """
    step = np.pi / 2 / rows
    elevation, azimuth = np.meshgrid((np.arange(rows) + 0.5) * step, np.arange(4 * rows) * step, indexing="ij")
    cosine = np.cos(elevation)
    directions = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return directions, cosine * np.sin(elevation) * step * step


def scattering_depth(turbidity: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3,) vertical optical depths by channel, of the molecules and of the aerosol.

    Source: Preetham et al. 1999 (doi:10.1145/311535.311545), appendix A.1.
    """
    molecules: NDArray[np.float64] = 0.008735 * CHANNEL_WAVELENGTH_UM**-_MOLECULES_EXPONENT
    aerosol: NDArray[np.float64] = (0.04608 * turbidity - 0.04586) * CHANNEL_WAVELENGTH_UM**-1.3
    return molecules, aerosol


def air_mass(elevation_deg: float) -> float:
    """Air in the direction of sun or moon above the horizon, in units of that overhead.

    Source: Kasten 1966 (doi:10.1007/BF02248840).
    """
    return float(1.0 / (np.sin(np.radians(elevation_deg)) + 0.15 * (elevation_deg + 3.885) ** -1.253))


def beam_transmission(elevation_deg: float, turbidity: float) -> NDArray[np.float64]:
    """(3,) share of the sun's or moon's light that air transmits directly, by channel; 0 once it has set.

    Source: optical depths as in `scattering_depth`, through `air_mass`.
    """
    lifted_deg = elevation_deg + _REFRACTION_AT_HORIZON_DEG * np.exp(-max(elevation_deg, 0.0) / 1.5)
    radius_deg = float(np.degrees(SUN_RADIUS_RAD))
    risen = float(np.clip((lifted_deg + radius_deg) / (2 * radius_deg), 0.0, 1.0))
    molecules, aerosol = scattering_depth(turbidity)
    result: NDArray[np.float64] = risen * np.exp(-(molecules + aerosol) * air_mass(max(lifted_deg, 0.0)))
    return result


def henyey_greenstein(cosine: NDArray[np.floating[Any]] | float, asymmetry: float) -> Any:
    """Henyey-Greenstein phase function of large particles, normalised over the sphere. [1/sr]"""
    g2 = asymmetry * asymmetry
    return (1.0 - g2) / (4.0 * np.pi) / (1.0 + g2 - 2.0 * asymmetry * cosine) ** 1.5
