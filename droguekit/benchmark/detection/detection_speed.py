"""Accuracy of detectors against their speed, with those of the seed paper, as inline SVG in the style of `figures`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter
from matplotlib.transforms import Bbox

from droguekit.benchmark.detection.detection_published import PUBLISHED_DETECTORS
from droguekit.benchmark.report.figures import INK, PANEL_IN, drawing, method_styles, svg_element
from droguekit.benchmark.report.number_text import plain_number
from droguekit.benchmark.results.detection_result import DetectionResult
from geometry.se3 import Array

# On a phone a panel stands a little smaller than drawn, and letters must not come below 8 px there.
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
    """Whether there is anything to show: a detector that was run for this result."""
    return any(detector.times is not None for detector in result.detectors.values())


def published_name(name: str) -> str:
    """What the seed paper calls a method, where it is not mistaken for one of ours."""
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
    """Each name as near to its mark as it can stand without touching another name, a mark, or the panel's edge."""
    figure.draw_without_rendering()
    area, point_px = axes.get_window_extent(), figure.dpi / 72
    marks = [axes.transData.transform(point) for point in [*names.values(), *others]]
    reach = _MARK_PT * point_px
    taken = [Bbox([mark - reach, mark + reach]) for mark in marks]
    for name, point in names.items():
        label = axes.annotate(name, point, (0, 0), textcoords="offset points", fontsize=_NAME_PT)
        # Names stand inside the panel, so they need no room around it.
        label.set_in_layout(False)
        # A line of letters with its ascenders and descenders; a browser's font may be a little wider than ours.
        size = np.array([1.05 * label.get_window_extent().width, _LINE_HEIGHT * _NAME_PT * point_px])
        choices = [
            (step, side, _box(axes.transData.transform(point), side, step * point_px, size))
            for step in _STEPS_PT
            for side in _SIDES
        ]
        # Where all is full, the name stands over others rather than nowhere.
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
    """Where a name of some size stands, in the canvas's pixels."""
    x, y = mark[0] + side[0] * step, mark[1] + side[1] * step
    left = x - {"left": 0.0, "center": 0.5, "right": 1.0}[side[2]] * size[0]
    low = y - {"bottom": 0.0, "center": 0.5, "top": 1.0}[side[3]] * size[1]
    return Bbox.from_bounds(left, low, *size)


def _is_free(box: Bbox, area: Bbox, taken: Sequence[Bbox]) -> bool:
    inside = area.x0 <= box.x0 and box.x1 <= area.x1 and area.y0 <= box.y0 and box.y1 <= area.y1
    return inside and not any(box.overlaps(other) for other in taken)
