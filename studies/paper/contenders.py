"""Who is compared: the three algorithms of the paper's figures, and ours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from droguekit.benchmark.report.figures import MethodStyle, method_styles
from studies.paper.published import DOCKING_MA, DOCKING_OURS, DOCKING_WANG, PublishedDocking


class Contender(NamedTuple):
    """A method as the page shows it.

    Attributes:
        method: its name in a file of estimates.
        label: what it is called on the page.
        published: what it stands for in the paper's docking runs; None for ours.
        is_filtered: its poses rest on those of pairs before, so their errors go from pair to pair.
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
