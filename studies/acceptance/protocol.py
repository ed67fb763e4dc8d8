"""Distances, noises and numbers of the benchmark protocol."""

from __future__ import annotations

STATIONS_M = (1.7, 2.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
SIGMAS_PX = (0.05, 0.1, 0.2, 0.35)
MARKER_COUNTS = (5, 7, 8)
# Corrupted markers are tried over the whole of this range, not at stations.
DOCKING_RANGE_M = (1.7, 10.0)
# Draws of a cell for methods that are solved in batches, and for those that are not.
BATCHED_DRAWS = 10_000
SINGLE_DRAWS = 1000
# The binomial error of a rate is then at most 0.0025: of 108 cells the unluckiest is still told from 0.02.
FLIP_DRAWS = 40_000
# The order of 5, 7 and 8 markers differs by two percent in the mean at least: so many draws tell it.
ORDER_DRAWS = 48_000
# By ten and more for the robust method, which takes longer.
ROBUST_ORDER_DRAWS = 2000
