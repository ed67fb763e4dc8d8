"""Accuracy of detectors against distance, their curves and histograms, as inline SVG in the style of `figures`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter

from droguekit.benchmark.detection.detection_curve import precision_recall
from droguekit.benchmark.detection.detection_matching import AT_50, Matches
from droguekit.benchmark.report.figures import INK, PANEL_IN, MethodStyle, drawing, method_styles, svg_element
from droguekit.benchmark.report.number_text import plain_number
from droguekit.benchmark.results.detection_result import DetectionResult, DetectorResult, DistanceRow
from geometry.se3 import Array

Measure = Literal["ap50", "ap", "recall"]
MEASURES: tuple[Measure, ...] = ("ap50", "recall", "ap")
_TITLES: dict[Measure, str] = {
    "ap50": "AP at overlap 0.5",
    "recall": "Recall at the operating threshold",
    "ap": "AP over overlaps 0.5 to 0.95",
}
_BAR_COUNT = 25
_TRUE_COLOR, _FALSE_COLOR = "#12946a", "#d03a3a"


def distance_panel(result: DetectionResult, measure: Measure) -> str:
    """One measure of every detector against distance, with its interval.

    Returns:
        An `<svg>` element.
    """
    with drawing(PANEL_IN) as (figure, axes):
        names = list(result.detectors)
        styles = method_styles(names)
        step = min(1.03, 1.25 ** (1 / len(names)))
        for k, name in enumerate(names):
            _draw_line(axes, result.detectors[name], measure, styles[name], step ** (k - (len(names) - 1) / 2))
        axes.set_xscale("log")
        axes.set_xlabel("Distance [m]")
        axes.xaxis.set_major_locator(FixedLocator([2, 5, 10, 20, 40]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.xaxis.set_minor_locator(NullLocator())
        _finish_share_axes(axes, _TITLES[measure])
        return svg_element(figure, f"distance-{measure}", f"{_TITLES[measure]} against distance, by detector")


def curve_panel(matches: Mapping[str, Matches]) -> str:
    """Precision against recall at overlap 0.5, by detector.

    Returns:
        An `<svg>` element.
    """
    with drawing(PANEL_IN) as (figure, axes):
        styles = method_styles(list(matches))
        for name, found in matches.items():
            curve = precision_recall(found)
            axes.plot(curve.recall, curve.precision, color=styles[name].color, linewidth=1.4)
        axes.set_xlim(0, 1.01)
        axes.set_xlabel("Recall")
        axes.xaxis.set_major_formatter(PercentFormatter(1.0))
        _finish_share_axes(axes, "Precision at overlap 0.5")
        return svg_element(figure, "curve", "Precision against recall, by detector")


def score_panel(name: str, number: int, matches: Matches, threshold: float) -> str:
    """How many boxes have which score, right and wrong ones.

    Args:
        name: of the detector.
        number: that keeps the element apart from others of the page.
        matches: of the detector.
        threshold: operating threshold, drawn as a line.

    Returns:
        An `<svg>` element.
    """
    true = matches.is_true[AT_50]
    highest = max(1.0, float(matches.score.max(initial=0.0)))
    bars = _Bars(np.linspace(0, highest, _BAR_COUNT + 1), ("right", "wrong"))
    with drawing(PANEL_IN) as (figure, axes):
        _draw_bars(axes, bars, (matches.score[true], matches.score[~true]))
        axes.axvline(threshold, color=INK, linestyle=(0, (4, 2)), linewidth=1.2)
        axes.set_xlabel("Score")
        axes.set_title(f"{_plain(name)}: boxes", fontsize=10.5, loc="left")
        return svg_element(figure, f"score-{number}", f"Scores of right and wrong boxes of {name}")


def size_panel(name: str, number: int, matches: Matches, threshold: float) -> str:
    """How many drogues of which width were found and missed at the operating threshold.

    Arguments and result as those of `score_panel`.
    """
    widths = np.array([image.box_xywh[2] for image in matches.images if image.box_xywh is not None])
    found = (matches.found_scores() >= threshold)[matches.has_drogue]
    low, high = float(widths.min()), float(widths.max())
    edges = np.geomspace(low, max(high, 1.001 * low) * 1.0001, _BAR_COUNT + 1)
    with drawing(PANEL_IN) as (figure, axes):
        _draw_bars(axes, _Bars(edges, ("found", "missed")), (widths[found], widths[~found]))
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator([10, 20, 50, 100, 200, 500, 1000]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlim(edges[0], edges[-1])
        axes.set_xlabel("Width of the box [px]")
        axes.set_title(f"{_plain(name)}: drogues", fontsize=10.5, loc="left")
        return svg_element(figure, f"size-{number}", f"Drogues found and missed by {name}, by width")


def _plain(name: str) -> str:
    """A name that matplotlib does not take for a formula."""
    return name.replace("$", r"\$")


class _Bars(NamedTuple):
    """Edges of the bars, and what the two heaps are called."""

    edges: Array
    labels: tuple[str, str]


def _draw_bars(axes: Axes, bars: _Bars, heaps: tuple[Array, Array]) -> None:
    """Two heaps on top of each other; heights go with the square root, so that a single one can be seen."""
    below = np.zeros(len(bars.edges) - 1)
    for values, label, color in zip(heaps, bars.labels, (_TRUE_COLOR, _FALSE_COLOR), strict=True):
        counts, _ = np.histogram(values, bars.edges)
        axes.bar(
            bars.edges[:-1],
            counts,
            np.diff(bars.edges),
            bottom=below,
            align="edge",
            color=color,
            label=f"{label} ({len(values)})",
        )
        below = below + counts
    axes.set_yscale("function", functions=(lambda v: np.sqrt(np.maximum(v, 0)), np.square))
    axes.set_ylim(0, None)
    # Above the bars, at the end of the title's line.
    axes.legend(
        frameon=False,
        fontsize=9,
        ncols=2,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.0,
        handlelength=1.0,
        columnspacing=1.0,
    )
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _draw_line(axes: Axes, detector: DetectorResult, measure: Measure, style: MethodStyle, shift: float) -> None:
    rows = [(row, value) for row in detector.distances if (value := getattr(row, measure)) is not None]
    if not rows:
        return
    y = np.array([value for _, value in rows])
    bars = np.array([_reach(row, measure, value) for row, value in rows]).T
    axes.errorbar(
        [_middle_m(row) * shift for row, _ in rows],
        y,
        yerr=bars,
        color=style.color,
        marker=style.marker,
        markersize=5,
        linewidth=1.2,
        elinewidth=0.9,
        capsize=2,
    )


def _reach(row: DistanceRow, measure: Measure, value: float) -> tuple[float, float]:
    """How far the interval goes down and up; nothing where there is none."""
    ends = {"ap50": row.ap50_interval, "recall": row.recall_interval, "ap": None}[measure]
    return (0.0, 0.0) if ends is None else (max(value - ends[0], 0.0), max(ends[1] - value, 0.0))


def _middle_m(row: DistanceRow) -> float:
    """Middle of a bin in the logarithm; those without an end are drawn as wide as a quarter of their other one."""
    low = row.low_m if row.low_m > 0 else (row.high_m or 1.0) / 1.6
    high = row.high_m if row.high_m is not None else 1.25 * row.low_m
    return float(np.sqrt(low * high))


def _finish_share_axes(axes: Axes, title: str) -> None:
    """A share upwards, from where there is something to see to 100 %."""
    axes.set_title(title, fontsize=10.5, loc="left")
    low = axes.get_ylim()[0]
    axes.set_ylim(max(0.0, min(np.floor(20 * low) / 20, 0.9)), 1.005)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0 if axes.get_ylim()[0] < 0.94 else 1))
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
