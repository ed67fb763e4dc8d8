"""How rough the air is."""

from __future__ import annotations

from typing import Literal

Turbulence = Literal["none", "light", "moderate", "severe"]
