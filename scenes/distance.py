"""Distance laws."""

from __future__ import annotations

import numpy as np

from datasets_manifest.recipe.pose_ranges import DistanceLaw


def sample_distance_m(rng: np.random.Generator, law: DistanceLaw, frame_index: int) -> float:
    """Distance of the rim centre along the optical axis. [m]

    Stations are gone through frame by frame, so that any prefix of a dataset covers all of them.
    """
    if law.stations_m is not None:
        return law.stations_m[frame_index % len(law.stations_m)]
    assert law.low_m is not None and law.high_m is not None
    u = rng.random()
    if law.law == "uniform":
        return float(law.low_m + u * (law.high_m - law.low_m))
    if law.law == "log-uniform":
        return float(law.low_m * (law.high_m / law.low_m) ** u)
    # The image's size goes with the inverse of the distance.
    return float(1.0 / (1.0 / law.high_m + u * (1.0 / law.low_m - 1.0 / law.high_m)))
