"""What the seed paper prints of its experiments, digit for digit; all of it is of data that are not public.

Source: "Research of an Unmanned Aerial Vehicle Autonomous Aerial Refueling Docking Method Based on Binocular Vision"
(docs/explanation/paper.md). Its table of detectors is in `droguekit.scoring.detection.detection_report`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from droguekit.scoring.report.figures import MethodStyle, method_styles

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
# by its plane fit, over 1.7 to 10 m, tilts to 10 degrees and the shipped drogue, as
# tests/studies/paper/test_published_results.py measures.
NOISE_OF_THE_MEAN_PX = 0.2
TILT_AT_THAT_NOISE_DEG = 6.0

CONTRADICTION = (
    "Two of the published claims cannot both come from single frames of this rig: by the paper's own construction a "
    f"mean position error of {1e3 * DOCKING_OURS.position_mean_m:.1f} mm means centroids good to about "
    f"{NOISE_OF_THE_MEAN_PX:g} px, and with such centroids pitch and yaw by the paper's plane fit err by about "
    f"{TILT_AT_THAT_NOISE_DEG:g}° RMS, not within ±{ANGLE_LIMIT_DEG:g}°."
)
"""Which published claims contradict each other."""


class Contender(NamedTuple):
    """A method as the page shows it.

    Attributes:
        method: its name in a file of estimates.
        label: what it is called on the page.
        published: its result in the paper's docking runs; None for ours.
        is_filtered: its poses depend on earlier pairs, so errors of neighbouring pairs are not independent.
    """

    method: str
    label: str
    published: PublishedDocking | None = None
    is_filtered: bool = False


OURS = "joint-hub"
FILTERED = f"{OURS}+filter"
PAPER = "paper"

CONTENDERS = (
    Contender(OURS, "ours (joint-hub)"),
    Contender(PAPER, "the paper's method, rebuilt (paper)", DOCKING_OURS),
    Contender("mono-circle", "Ma et al., reconstructed (mono-circle)", DOCKING_MA),
    Contender("circle-fit", "Wang et al., reconstructed (circle-fit)", DOCKING_WANG),
    Contender(FILTERED, "ours, filtered (joint-hub+filter)", is_filtered=True),
)

NAVIGATE_OPTIONS = " ".join(f"--method {contender.method}" for contender in CONTENDERS[:4])
"""Of `droguekit navigate`, for a file with all of them but the filtered one."""


def present(methods: Iterable[str]) -> list[Contender]:
    """Those of which there are estimates, in the order of the page."""
    names = set(methods)
    return [contender for contender in CONTENDERS if contender.method in names]


def absent(methods: Iterable[str]) -> list[Contender]:
    """Those of which there are none, but for the filtered one, which no figure of the paper needs."""
    names = {*methods, FILTERED}
    return [contender for contender in CONTENDERS if contender.method not in names]


def style_of(method: str) -> MethodStyle:
    """How a contender is drawn in every figure of the page."""
    return method_styles([contender.method for contender in CONTENDERS])[method]
