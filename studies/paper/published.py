"""What the seed paper prints of its experiments, digit for digit; all of it is of data that are not public.

Source: "Research of an Unmanned Aerial Vehicle Autonomous Aerial Refueling Docking Method Based on Binocular Vision"
(docs/explanation/paper.md). Its table of detectors stands in `droguekit.benchmark.detection.detection_published`.
"""

from __future__ import annotations

from typing import NamedTuple

TITLE = "Research of an Unmanned Aerial Vehicle Autonomous Aerial Refueling Docking Method Based on Binocular Vision"


class PublishedDocking(NamedTuple):
    """Mean position error over the docking runs of the view simulation. [m]"""

    name: str
    position_mean_m: float


class PublishedStation(NamedTuple):
    """A row of the semi-physical table.

    Attributes:
        name: of the method, as printed.
        markers: how many, where the row says so.
        x_m, y_m: printed with a "less or equal". [m]
        z_fraction: of the distance, likewise.
    """

    name: str
    markers: int | None
    x_m: float
    y_m: float
    z_fraction: float


# Section 4.3.1, text below Figure 18: average Euclidean distance from the true point.
DOCKING_WANG = PublishedDocking("Wang's method", 0.2176)
DOCKING_MA = PublishedDocking("Ma's method", 0.0541)
DOCKING_OURS = PublishedDocking("the paper's method", 0.0214)

# Abstract and section 4.3.1: all errors of the view simulation are said to lie within these.
POSITION_LIMIT_M = 0.1
ANGLE_LIMIT_DEG = 0.5

# Table 2.
TABLE_2 = (
    PublishedStation("Wang's method", None, 0.070, 0.065, 0.0395),
    PublishedStation("Ma's method", None, 0.050, 0.050, 0.0239),
    PublishedStation("Ours-5 Points", 5, 0.065, 0.065, 0.0121),
    PublishedStation("Ours-7 Points", 7, 0.040, 0.040, 0.0103),
)

# Abstract and section 4.2: of "ours-l" on an Nvidia Xavier AGX.
DETECTION_MAP = 0.9823
DETECTION_FPS = 41.11

# Section 4.1, the data of Figure 10.
CORPUS_SENTENCE = (
    "The paper's corpus has 14,298 images of about 89 scenes, with the drogue from about 2 to 40 m; its Figure 10 "
    "prints no numbers."
)

# Centroids of this noise give the published mean error by the method as it is rebuilt here, and this error of the tilt
# by its plane fit, over 1.7 to 10 m, tilts to 10 degrees and the shipped drogue: tests/studies/paper/test_published.py.
NOISE_OF_THE_MEAN_PX = 0.2
TILT_AT_THAT_NOISE_DEG = 6.0

CONTRADICTION = (
    "Two of the published claims cannot both come from single frames of this rig: by the paper's own construction a "
    f"mean position error of {1e3 * DOCKING_OURS.position_mean_m:.1f} mm means centroids good to about "
    f"{NOISE_OF_THE_MEAN_PX:g} px, and with such centroids pitch and yaw by the paper's plane fit err by about "
    f"{TILT_AT_THAT_NOISE_DEG:g}° RMS, not within ±{ANGLE_LIMIT_DEG:g}°."
)
"""The honest sentence about what does not fit together."""
