"""Units in which a calibration may give its baseline."""

from __future__ import annotations

BASELINE_UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
