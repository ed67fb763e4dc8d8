"""Where what stands in the vector of an annulus's parameters."""

from __future__ import annotations

import numpy as np

from nav.centroids.disc_places import ELLIPSE_PARAMETERS

OUTER = slice(0, ELLIPSE_PARAMETERS)
INNER = slice(ELLIPSE_PARAMETERS, 2 * ELLIPSE_PARAMETERS)
CENTERS = np.array([0, 1, ELLIPSE_PARAMETERS, ELLIPSE_PARAMETERS + 1])
WIDTH, BACKGROUND, HOLE = (2 * ELLIPSE_PARAMETERS + i for i in range(3))
# What lies beyond is lighter towards one side than towards another: a constant and the first two orders of the azimuth.
BEYOND, BEYOND_TURNS = HOLE + 1, 5
# Light on the annulus by the azimuth, the constant first.
AMPLITUDE = BEYOND + BEYOND_TURNS
