"""The wavelengths that the atmosphere is computed at, and linear Rec. 709 from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.sky.photometry import REC709_FROM_XYZ

WAVELENGTH_UM = np.array([0.40, 0.44, 0.48, 0.52, 0.56, 0.60, 0.64, 0.68])

# Sunlight outside the atmosphere from 380 to 720 nm in steps of 10 nm (ASTM G173-03). [W/m2/nm]
_SUN_NM = np.arange(380.0, 721.0, 10.0)
_SUN = np.array(
    [
        *(1.0125, 1.1472, 1.7277, 1.7305, 1.6887, 1.6125, 1.9120, 2.0347, 2.0204, 2.0221, 1.9338, 1.9581, 1.9169),
        *(1.8298, 1.8685, 1.8931, 1.8515, 1.8504, 1.8341, 1.8345, 1.8147, 1.7816, 1.7533, 1.6965, 1.6819, 1.6465),
        *(1.6048, 1.5214, 1.5562, 1.5113, 1.4740, 1.4482, 1.4102, 1.3678, 1.3419),
    ]
)
# Cross sections of ozone at 223 K, averaged over 40 nm around each wavelength (Serdyuchenko et al. 2014,
# doi:10.5194/amt-7-625-2014). [m2]
_OZONE_M2 = np.array([2.0e-27, 1.73e-26, 7.8e-26, 2.20e-25, 4.04e-25, 4.53e-25, 2.73e-25, 1.32e-25])
_DOBSON_PER_M2 = 2.687e20
_OZONE_DOBSON = 300.0

MOLECULE_DEPTH = 0.008569 * WAVELENGTH_UM**-4 * (1.0 + 0.0113 * WAVELENGTH_UM**-2 + 0.00013 * WAVELENGTH_UM**-4)
"""(L,) vertical optical depth of the molecules (Hansen and Travis 1974, doi:10.1007/BF00168069, eq. 2.30)."""
OZONE_DEPTH = _OZONE_M2 * _DOBSON_PER_M2 * _OZONE_DOBSON
"""(L,) vertical optical depth of ozone."""
AEROSOL_RELATIVE = (WAVELENGTH_UM / 0.55) ** -1.3
"""(L,) extinction of aerosol over that at 550 nm (Angstrom's exponent of continental haze)."""
MOLECULE_DEPTH_550 = 0.0973
"""Vertical optical depth of the molecules at 550 nm, by the same formula."""


def _lobe(nm: NDArray[np.float64], center: float, below: float, above: float) -> NDArray[np.float64]:
    slope = np.where(nm < center, below, above)
    lobe: NDArray[np.float64] = np.exp(-0.5 * ((nm - center) * slope) ** 2)
    return lobe


def color_matching(nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) CIE 1931 colour-matching functions of (...) wavelengths. [nm]

    Source: Wyman, Sloan, Shirley 2013, JCGT 2(2).
    """
    x = (
        0.362 * _lobe(nm, 442.0, 0.0624, 0.0374)
        + 1.056 * _lobe(nm, 599.8, 0.0264, 0.0323)
        - 0.065 * _lobe(nm, 501.1, 0.0490, 0.0382)
    )
    y = 0.821 * _lobe(nm, 568.8, 0.0213, 0.0247) + 0.286 * _lobe(nm, 530.9, 0.0613, 0.0322)
    z = 1.217 * _lobe(nm, 437.0, 0.0845, 0.0278) + 0.681 * _lobe(nm, 459.0, 0.0385, 0.0725)
    matching: NDArray[np.float64] = np.stack([x, y, z], axis=-1)
    return matching


def _rgb_weights() -> NDArray[np.float64]:
    """(L, 3) linear Rec. 709, scaled so that sunlight outside the atmosphere is (1, 1, 1), of light over sunlight."""
    nm = np.arange(380.0, 721.0)
    shapes = np.stack([np.interp(nm, 1e3 * WAVELENGTH_UM, hat) for hat in np.eye(len(WAVELENGTH_UM))])
    xyz = np.einsum("ln,nk->lk", shapes * np.interp(nm, _SUN_NM, _SUN), color_matching(nm))
    # White is the sun, in the axes of cones as for the other skies (Lam 1985).
    cones = np.einsum("lk,ck->lc", xyz, BRADFORD)
    cones *= np.einsum("ck,k->c", BRADFORD, D65_XYZ) / cones.sum(axis=0)
    rgb = np.einsum("lc,kc->lk", cones, REC709_FROM_XYZ @ np.linalg.inv(BRADFORD))
    result: NDArray[np.float64] = rgb / rgb.sum(axis=0)
    return result


D65_XYZ = np.array([0.95047, 1.0, 1.08883])
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
RGB_WEIGHTS = _rgb_weights()


def rgb_of_spectrum(relative: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """(..., 3) linear Rec. 709 of (..., L) light over sunlight outside the atmosphere; no channel is negative."""
    rgb: NDArray[np.float64] = np.maximum(np.einsum("...l,lc->...c", relative, RGB_WEIGHTS), 0.0)
    return rgb


def spectrum_of_rgb(rgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., L) smooth reflectance of (..., 3) reflectances by channel."""
    blue, green, red = 0.465, 0.55, 0.61
    share = np.stack([np.interp(WAVELENGTH_UM, (blue, green, red), hat) for hat in np.eye(3)[::-1]], axis=-1)
    result: NDArray[np.float64] = np.einsum("...c,lc->...l", rgb, share)
    return result
