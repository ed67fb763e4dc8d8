"""Compile the numba loops before the first pair arrives."""

from __future__ import annotations

from functools import cache

import numpy as np

from drogue_models.marker_layout import marker_layout
from drogue_models.presets import PRESETS
from geometry.stereo import paper_rig
from nav.centroids.annuli import fit_annuli
from nav.centroids.blurred_edges import blurred_step
from nav.centroids.disc_fit import fit_discs
from nav.centroids.ellipses import circles
from nav.centroids.marker_signal import MarkerSignal
from nav.pose.features import stack_features
from nav.pose.joint import solve_one
from nav.pose.marker_geometry import project_markers

_RADII_PX = 12.0, 8.0
_SIDE_PX, _MIDDLE_PX = 40, 20.0
_LIGHT_DN = 100.0
_DISTANCE_M = 5.0


@cache
def warm_up_jit() -> None:
    """Run the compiled loops once: fit a drawn disc and a drawn annulus in each eye, and a pose.

    The loops take seconds to compile at their first use on a machine, and tenths of a second to load in every later
    process. In real time, pairs that arrive meanwhile would be late.
    """
    _fit_edges()
    rig, layout = paper_rig(), marker_layout(PRESETS["red-8"])
    pixels = project_markers(rig, layout, np.eye(3)[None], np.array([[0.1, 0.1, _DISTANCE_M]]))
    solve_one(stack_features(rig, layout, pixels, np.eye(2)), np.ones(pixels.shape[1:3], dtype=bool))


def _fit_edges() -> None:
    row = np.arange(_SIDE_PX) - _MIDDLE_PX
    distance = np.hypot(row, row[:, None])
    outer, inner = (
        circles(np.arange(2), np.full((2, 2), _MIDDLE_PX), np.full(2, radius_px)) for radius_px in _RADII_PX
    )
    outside, hole = (
        np.clip(sign * (distance - radius) + 0.5, 0, 1) for sign, radius in zip((1, -1), _RADII_PX, strict=True)
    )
    disc, annulus = (
        MarkerSignal(light.astype(np.float32), light < 0, (0.0, 0.0), 1, True)
        for light in (_LIGHT_DN * (1 - outside), _LIGHT_DN * (1 - outside - hole))
    )
    # The background of small markers is drawn by this function directly.
    blurred_step(disc.values)
    fits = fit_discs([disc, disc], outer)
    if fits.noise is not None:
        fit_annuli([annulus, annulus], outer, inner, fits.noise)
