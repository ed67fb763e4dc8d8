"""The air that a receiver's nose pushes aside."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array


def bow_wave(points_m: Array, source_m: Array, airspeed_m_s: float, body_radius_m: float) -> Array:
    """What a round nose adds to the velocity of the air.

    Args:
        points_m: (3, S, M) where. [m]
        source_m: (3, S) places of the sources, half a radius behind the tips of the noses. [m]
        airspeed_m_s: of the receiver. [m/s]
        body_radius_m: of the body far behind its nose. [m]

    Returns:
        (3, S, M) `V a^2 / 4 r / |r|^3`; inside the body no more than the airspeed, its value at the tip. [m/s]

    Source: Rankine's half-body, a point source in a uniform stream; Milne-Thomson, Theoretical Hydrodynamics, ch. 15.
    """
    away = points_m - source_m[..., None]
    square = np.maximum(np.einsum("ism,ism->sm", away, away), (body_radius_m / 2) ** 2)
    pushed: Array = (airspeed_m_s * body_radius_m**2 / 4) * away / (square * np.sqrt(square))
    return pushed
