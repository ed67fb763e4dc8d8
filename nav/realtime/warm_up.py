"""What is compiled, or loaded, at the first fit of a process, done before anybody waits for an answer."""

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
from nav.pose.marker_geometry import predict_px

_RADII_PX = 12.0, 8.0
_SIDE_PX, _MIDDLE_PX = 40, 20.0
_LIGHT_DN = 100.0
_DISTANCE_M = 5.0


@cache
def fit_once() -> None:
    """Fit a drawn disc and a drawn annulus in each eye, and a pose.

    The loops take seconds to compile when they are first used on a machine, and tenths of a second to load
    in every other process. In real time the pairs that come meanwhile would be late.
    """
    _fit_edges()
    rig, layout = paper_rig(), marker_layout(PRESETS["red-8"])
    pixels = predict_px(rig, layout, np.eye(3)[None], np.array([[0.1, 0.1, _DISTANCE_M]]))
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
    # Small markers' surroundings are drawn with the step by itself.
    blurred_step(disc.values)
    fits = fit_discs([disc, disc], outer)
    if fits.noise is not None:
        fit_annuli([annulus, annulus], outer, inner, fits.noise)
