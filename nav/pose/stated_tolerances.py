"""What a user states about how far his drogue and rig may depart from their nominal dimensions."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class StatedTolerances:
    """Standard deviations about the nominal dimensions; 0, the default, stands for exactly as built.

    Least-squares methods count with them: what all markers share becomes an unknown of its own with this prior, what
    each marker has for itself adds to the covariance of its two images.

    Attributes:
        ring_radius_m: of the circle through the markers.
        ellipticity: difference of that circle's axes over their mean, along an unknown direction. Of this size, not a
            standard deviation.
        placement_m: of every marker along each axis.
        hub_lateral_m: of the hub along both axes across the drogue's.
        disparity_px: of the right eye's columns. A yaw of the right camera by an angle moves them by the focal length
            in pixels times the angle, an error of its principal point by itself.
    """

    ring_radius_m: float = 0.0
    ellipticity: float = 0.0
    placement_m: float = 0.0
    hub_lateral_m: float = 0.0
    disparity_px: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{field.name}: must be 0 or more, got {value}")


EXACT = StatedTolerances()
