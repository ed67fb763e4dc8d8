"""Which way a towed drogue points: between the air that meets it and the hose that holds it, with a lag."""

from __future__ import annotations

import numpy as np

from geometry.se3 import Array, angles_from_axis, rotation_from_angles

# Share of the relative wind in the direction; the rest is the last link's. Our reconstruction.
_WIND_SHARE = 0.7
_LAG_S = 0.15
# Slower air than this turns the drogue less than its own weight does. [m/s]
_WEAK_WIND_M_S = 1.0
# A level camera that looks ahead (right, down, forward), seen from the tanker's axes (aft, right, up).
LEVEL_CAMERA_FROM_TANKER = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])


def mouth_directions(past_m_s: Array, last_link: Array, period_s: float) -> Array:
    """Directions from the coupling to the mouth, lagged and not of unit length.

    Args:
        past_m_s: (T, 3) velocity of the air past the drogue. [m/s]
        last_link: (T, 3) last link of the hose, towards the drogue.
        period_s: of the samples. [s]

    Returns:
        (T, 3) a first-order lag of what the air and the hose want, straight between the samples.
    """
    wanted = _wanted(past_m_s, last_link)
    ratio = period_s / _LAG_S
    keep = np.exp(-ratio)
    # Exact for an input that goes straight from sample to sample.
    newer = 1 - (1 - keep) / ratio
    lagged = np.empty_like(wanted)
    lagged[0] = wanted[0]
    for k in range(1, len(wanted)):
        lagged[k] = keep * lagged[k - 1] + (1 - keep - newer) * wanted[k - 1] + newer * wanted[k]
    return lagged


def still_mouth_direction(airspeed_m_s: float, last_link: Array) -> Array:
    """(3,) unit direction from the coupling to the mouth in still air, with the hose's (3,) last link."""
    return _wanted(np.array([airspeed_m_s, 0.0, 0.0]), last_link)


def _wanted(past_m_s: Array, last_link: Array) -> Array:
    """(..., 3) unit directions that air and hose want the mouth to have."""
    speed = np.linalg.norm(past_m_s, axis=-1, keepdims=True)
    wind = past_m_s / np.hypot(speed, _WEAK_WIND_M_S)
    link = last_link / np.linalg.norm(last_link, axis=-1, keepdims=True)
    wanted: Array = _WIND_SHARE * wind + (1 - _WIND_SHARE) * link
    wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
    return wanted


def drogue_rotation(mouth: Array, roll_rad: float) -> Array:
    """(3, 3) rotation `tanker_from_drogue` of a drogue whose mouth points along (3,) `mouth`, without spin."""
    pitch, yaw = angles_from_axis(-LEVEL_CAMERA_FROM_TANKER @ (mouth / np.linalg.norm(mouth)))
    rotation: Array = LEVEL_CAMERA_FROM_TANKER.T @ rotation_from_angles(float(pitch), float(yaw), roll_rad)
    return rotation
