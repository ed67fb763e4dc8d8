"""Panels of the detection report as inline SVG: accuracy against distance and speed, curves, histograms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter
from matplotlib.transforms import Bbox

from droguekit.scoring.detection.detection_metrics import AT_50, Matches, precision_recall
from droguekit.scoring.detection.detection_scores import ScoredDetections
from droguekit.scoring.detection.detection_tables import PUBLISHED_DETECTORS
from droguekit.scoring.detection.detection_truth import ImageTruth
from droguekit.scoring.report.figures import INK, PANEL_IN, MethodStyle, drawing, method_styles, svg_element
from droguekit.scoring.report.number_text import plain_number
from droguekit.scoring.results.detection_result import DetectionResult, DistanceRow
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


def distance_panel(scored: ScoredDetections, measure: Measure) -> str:
    """One measure of every detector against distance, with its interval; see `bin_distance_m` for a bin's place.

    Returns:
        An `<svg>` element.
    """
    with drawing(PANEL_IN) as (figure, axes):
        detectors = scored.result.detectors
        names = list(detectors)
        styles = method_styles(names)
        step = min(1.03, 1.25 ** (1 / len(names)))
        for k, name in enumerate(names):
            rows = [(bin_distance_m(row, scored.images), row) for row in detectors[name].distances]
            _draw_line(axes, rows, measure, styles[name], step ** (k - (len(names) - 1) / 2))
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
    """A name that matplotlib does not parse as a formula."""
    return name.replace("$", r"\$")


class _Bars(NamedTuple):
    """Edges of the bars, and labels of the two stacked histograms."""

    edges: Array
    labels: tuple[str, str]


def _draw_bars(axes: Axes, bars: _Bars, heaps: tuple[Array, Array]) -> None:
    """Two stacked histograms with a square-root axis, so that single counts are visible."""
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


def bin_distance_m(row: DistanceRow, images: Sequence[ImageTruth]) -> float:
    """Geometric mean of the distances of a bin's images, of which there is at least one. [m]"""
    high_m = np.inf if row.high_m is None else row.high_m
    distances_m = [image.distance_m for image in images if image.distance_m is not None]
    return float(np.exp(np.mean([np.log(each) for each in distances_m if row.low_m <= each < high_m])))


def _draw_line(
    axes: Axes, rows: Sequence[tuple[float, DistanceRow]], measure: Measure, style: MethodStyle, shift: float
) -> None:
    """One detector's line; `rows` go with their distances."""
    known = [(place_m, row, value) for place_m, row in rows if (value := getattr(row, measure)) is not None]
    if not known:
        return
    y = np.array([value for _, _, value in known])
    bars = np.array([_reach(row, measure, value) for _, row, value in known]).T
    axes.errorbar(
        [place_m * shift for place_m, _, _ in known],
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


def _finish_share_axes(axes: Axes, title: str) -> None:
    """A share upwards, from where there is something to see to 100 %."""
    axes.set_title(title, fontsize=10.5, loc="left")
    low = axes.get_ylim()[0]
    axes.set_ylim(max(0.0, min(np.floor(20 * low) / 20, 0.9)), 1.005)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0 if axes.get_ylim()[0] < 0.94 else 1))
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


# A phone shows a panel a little smaller than drawn; letters must stay above 8 px there.
_NAME_PT = 9.0
_LINE_HEIGHT = 1.3

# Ways to set a name off from its mark: where to, and which edges of the name lie there.
_SIDES = (
    (1, 0, "left", "center"),
    (-1, 0, "right", "center"),
    (0, 1, "center", "bottom"),
    (0, -1, "center", "top"),
    (1, 1, "left", "bottom"),
    (1, -1, "left", "top"),
    (-1, 1, "right", "bottom"),
    (-1, -1, "right", "top"),
)
_STEPS_PT = (6, 12, 20, 30, 42, 56, 72, 90, 110)

# From here on a thin line leads from a name to its mark.
_FAR_PT = 12
_MARK_PT = 4.0

_Point = tuple[float, float]


def is_timed(result: DetectionResult) -> bool:
    """Whether a detector was run for this result, so that there is a time to show."""
    return any(detector.times is not None for detector in result.detectors.values())


def published_name(name: str) -> str:
    """The seed paper's name of a method, marked where it could be mistaken for one of ours."""
    return f"{name} (the paper's)" if name.lower().startswith("ours") else name


def speed_panel(result: DetectionResult) -> str:
    """AP50 of every detector that was timed against the time of an image; published ones are hollow and named.

    Returns:
        An `<svg>` element.
    """
    with drawing(PANEL_IN) as (figure, axes):
        published = {published_name(row.name): (1e3 * row.image_s, row.ap50) for row in PUBLISHED_DETECTORS}
        for point in published.values():
            axes.plot(*point, "o", markersize=5, markerfacecolor="none", markeredgecolor=INK)
        styles, measured = method_styles(list(result.detectors)), list[_Point]()
        for name, detector in result.detectors.items():
            if detector.times is not None and detector.overall.ap50 is not None:
                style = styles[name]
                image_ms = detector.times.wall_ms / 2
                measured.append((image_ms, detector.overall.ap50))
                axes.plot(*measured[-1], style.marker, color=style.color, markersize=7)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        bottom, top = axes.get_ylim()
        # Room for the names around the marks.
        axes.set(xlim=(low / 1.5, high * 1.5), ylim=(bottom - 0.1 * (top - bottom), top + 0.1 * (top - bottom)))
        ticks = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000]
        # Over many decades only these, or their numbers would touch.
        axes.xaxis.set_major_locator(FixedLocator(ticks if high < 100 * low else ticks[::3]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("Time of an image [ms]")
        axes.set_title("AP at overlap 0.5 (hollow: published, other data)", fontsize=10.5, loc="left")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=1))
        axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        _write_names(figure, axes, published, measured)
        return svg_element(figure, "speed", "AP50 against time of an image, by detector, and of published ones")


def _write_names(figure: Figure, axes: Axes, names: dict[str, _Point], others: Sequence[_Point]) -> None:
    """Place each name as near to its mark as possible without touching another name, a mark, or the panel's edge."""
    figure.draw_without_rendering()
    area, point_px = axes.get_window_extent(), figure.dpi / 72
    marks = [axes.transData.transform(point) for point in [*names.values(), *others]]
    reach = _MARK_PT * point_px
    taken = [Bbox([mark - reach, mark + reach]) for mark in marks]
    for name, point in names.items():
        label = axes.annotate(name, point, (0, 0), textcoords="offset points", fontsize=_NAME_PT)
        # Names lie inside the panel, so they need no room around it.
        label.set_in_layout(False)
        # A line of letters with its ascenders and descenders; a browser's font may be a little wider than ours.
        size = np.array([1.05 * label.get_window_extent().width, _LINE_HEIGHT * _NAME_PT * point_px])
        choices = [
            (step, side, _box(axes.transData.transform(point), side, step * point_px, size))
            for step in _STEPS_PT
            for side in _SIDES
        ]
        # Without free space the name overlaps others rather than being left out.
        step, side, box = next((c for c in choices if _is_free(c[2], area, taken)), choices[0])
        label.set(position=(side[0] * step, side[1] * step), ha=side[2], va=side[3])
        if step >= _FAR_PT:
            axes.annotate(
                "",
                point,
                (side[0] * step, side[1] * step),
                textcoords="offset points",
                arrowprops={
                    "arrowstyle": "-",
                    "color": INK,
                    "alpha": 0.5,
                    "linewidth": 0.6,
                    "shrinkA": 0,
                },
            ).set_in_layout(False)
        taken.append(box)


def _box(mark: Array, side: tuple[int, int, str, str], step: float, size: Array) -> Bbox:
    """Box of a name of some size, in pixels of the canvas."""
    x, y = mark[0] + side[0] * step, mark[1] + side[1] * step
    left = x - {"left": 0.0, "center": 0.5, "right": 1.0}[side[2]] * size[0]
    low = y - {"bottom": 0.0, "center": 0.5, "top": 1.0}[side[3]] * size[1]
    return Bbox.from_bounds(left, low, *size)


def _is_free(box: Bbox, area: Bbox, taken: Sequence[Bbox]) -> bool:
    inside = area.x0 <= box.x0 and box.x1 <= area.x1 and area.y0 <= box.y0 and box.y1 <= area.y1
    return inside and not any(box.overlaps(other) for other in taken)
