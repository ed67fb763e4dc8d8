"""Where what stands in the vector of an annulus's parameters."""

from __future__ import annotations

import numpy as np

from nav.centroids.disc_places import ELLIPSE_PARAMETER_COUNT

ANNULUS_OUTER = slice(0, ELLIPSE_PARAMETER_COUNT)
ANNULUS_INNER = slice(ELLIPSE_PARAMETER_COUNT, 2 * ELLIPSE_PARAMETER_COUNT)
ANNULUS_CENTERS = np.array([0, 1, ELLIPSE_PARAMETER_COUNT, ELLIPSE_PARAMETER_COUNT + 1])
ANNULUS_WIDTH, ANNULUS_BACKGROUND, ANNULUS_HOLE = (2 * ELLIPSE_PARAMETER_COUNT + i for i in range(3))
# What lies beyond is lighter towards one side than towards another: a constant and the first two orders of the azimuth.
ANNULUS_SURROUND, ANNULUS_SURROUND_COUNT = ANNULUS_HOLE + 1, 5
# Light on the annulus by the azimuth, the constant first.
ANNULUS_AMPLITUDE = ANNULUS_SURROUND + ANNULUS_SURROUND_COUNT
