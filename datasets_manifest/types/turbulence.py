"""How rough the air is."""

from __future__ import annotations

from typing import Literal

Turbulence = Literal["none", "light", "moderate", "severe"]

SLOWEST_M_S = 5.0
"""Airspeed from which on there can be turbulence: a frozen field needs to be flown through. [m/s]"""
