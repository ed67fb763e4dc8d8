"""Panels of the reports, drawn as inline SVG that takes the text colour of the page and needs nothing from outside."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator, PercentFormatter

from droguekit.scoring.report.number_text import plain_number
from droguekit.scoring.results.benchmark_result import BenchmarkResult, MethodResult, ReferenceBin
from droguekit.scoring.results.sequence_result import OverlapRow
from droguekit.scoring.sequences.tracking_scores import (
    CENTER_ERRORS_PX,
    NORMALIZED_ERRORS,
    OVERLAPS,
    PRECISION_AT_PX,
)
from geometry.se3 import Array

# Mid-tones (our choice): each is visible on white and on black, and neighbours differ in lightness and hue.
_COLORS = (
    *("#1f78c8", "#e0660a", "#12946a", "#c2589c", "#b58900", "#3ba7d6", "#8a63d2", "#d03a3a", "#9a6a3a", "#7f8890"),
    *("#7aa61e", "#e58fb0", "#3d5ba9"),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "p", "*", "d")

# Placeholder for the page's text colour while matplotlib draws.
INK = "#010203"

_STYLE = {
    "svg.hashsalt": "droguekit",  # element ids that do not change from run to run
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10.0,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}

PANEL_IN = (4.4, 3.3)

# With more methods than this, panels are larger and intervals fainter, so that lines can be told apart.
FEW_METHODS = 6
LARGE_PANEL_IN = (6.6, 5.0)


@dataclass(frozen=True)
class Quantity:
    """The quantity of a panel.

    Attributes:
        key: of the row.
        bound_key: of the bound.
        title: above the panel, with the unit.
        scale: from the row's unit to the panel's.
    """

    key: str
    bound_key: str
    title: str
    scale: float


QUANTITIES = (
    Quantity("position_rmse_m", "position_m", "Position, RMS error [mm]", 1e3),
    Quantity("x_rmse_m", "x_m", "X (to the right), RMS error [mm]", 1e3),
    Quantity("y_rmse_m", "y_m", "Y (down), RMS error [mm]", 1e3),
    Quantity("z_rmse_m", "z_m", "Z (depth), RMS error [mm]", 1e3),
    Quantity("pitch_rmse_deg", "pitch_deg", "Pitch, RMS error [deg]", 1.0),
    Quantity("yaw_rmse_deg", "yaw_deg", "Yaw, RMS error [deg]", 1.0),
)


@dataclass(frozen=True)
class MethodStyle:
    """How a method is drawn everywhere."""

    color: str
    marker: str


def method_styles(methods: Sequence[str]) -> dict[str, MethodStyle]:
    """Colour and marker of each method; no two of the first 13 share either, nor of the first 169 both."""
    return {
        name: MethodStyle(_COLORS[k % len(_COLORS)], _MARKERS[(k + k // len(_COLORS)) % len(_MARKERS)])
        for k, name in enumerate(methods)
    }


def error_panel(result: BenchmarkResult, quantity: Quantity) -> str:
    """One quantity of every method against distance, with its interval and the bound, both axes logarithmic.

    Returns:
        An `<svg>` element.
    """
    with drawing(_size_in(len(result.methods))) as (figure, axes):
        _draw_errors(axes, result, quantity)
        return svg_element(figure, quantity.key, f"{quantity.title} against distance, by method")


def error_figure(result: BenchmarkResult, quantity: Quantity) -> Figure:
    """The same panel as a figure of its own on white, with a legend, to show or to save."""
    with drawing(LARGE_PANEL_IN) as (figure, axes):
        figure.patch.set(alpha=1.0, facecolor="white")
        _draw_errors(axes, result, quantity)
        axes.legend(frameon=False, fontsize=9)
    return figure


def _draw_errors(axes: Axes, result: BenchmarkResult, quantity: Quantity) -> None:
    names = list(result.methods)
    few = len(names) <= FEW_METHODS
    styles = method_styles(names)
    # A little apart, so that methods do not cover each other, and all within an eighth of the true distance.
    step = min(1.03, 1.25 ** (1 / len(names)))
    for k, name in enumerate(names):
        shift = step ** (k - (len(names) - 1) / 2)
        _draw_method(axes, name, result.methods[name], quantity, styles[name], (shift, 1.0 if few else 0.3))
    _draw_bound(axes, result.reference, quantity)
    if not axes.has_data():
        axes.text(0.5, 0.5, "every error is 0", transform=axes.transAxes, ha="center", va="center")
    finish_distance_axes(axes, quantity.title)


def legend_key(style: MethodStyle | None) -> str:
    """A short line as the panels draw it, for the page's legend; None is the bound."""
    with drawing((0.5, 0.2)) as (figure, axes):
        axes.set_position((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, 2), ylim=(-1, 1))
        if style is None:
            axes.plot([0, 2], [0, 0], color=INK, linestyle=(0, (4, 2)), linewidth=1.4)
        else:
            axes.plot([0, 1, 2], [0, 0, 0], color=style.color, marker=style.marker, markevery=[1], markersize=6)
        return svg_element(figure, "key", "")


def _draw_method(
    axes: Axes, name: str, method: MethodResult, quantity: Quantity, style: MethodStyle, place: tuple[float, float]
) -> None:
    """One line; `place` is its shift in distance and the opacity of its intervals."""
    shift, opacity = place
    rows = [(row, row.value(quantity.key)) for row in method.bins]
    # A logarithmic axis cannot show an error of exactly 0.
    points = [(row, value) for row, value in rows if value is not None and value > 0]
    if not points:
        return
    x = np.array([middle_m(row.low_m, row.high_m) * shift for row, _ in points])
    y = np.array([value for _, value in points])
    ends = np.array([row.intervals[quantity.key] for row, _ in points])
    bars = np.abs(ends - y[:, None]).T
    axes.errorbar(
        x,
        y * quantity.scale,
        yerr=bars * quantity.scale,
        color=style.color,
        ecolor=to_rgba(style.color, opacity),
        marker=style.marker,
        markersize=5,
        linewidth=1.2,
        elinewidth=0.9,
        capsize=2 if opacity == 1 else 0,
        label=name,
    )


def _draw_bound(axes: Axes, reference: Sequence[ReferenceBin], quantity: Quantity) -> None:
    places = [(middle_m(b.low_m, b.high_m), getattr(b.bound, quantity.bound_key)) for b in reference if b.bound]
    drawn = [(x, y * quantity.scale) for x, y in places if y > 0]
    if drawn:
        # A single distance has no line, so a cross marks it.
        x, y = zip(*drawn, strict=True)
        axes.plot(
            x, y, color=INK, linestyle=(0, (4, 2)), linewidth=1.6, marker="+", markersize=5, zorder=5, label="bound"
        )


def finish_distance_axes(axes: Axes, title: str) -> None:
    """Both axes logarithmic, with plain numbers, a grid and a title."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.set_xlabel("Distance [m]")
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
    low, high = axes.get_ylim()
    # Only decades where there are enough of them, else 1, 2 and 5 of each.
    subdivisions = (1.0,) if np.log10(high / low) > 3 else (1.0, 2.0, 5.0)
    for axis, parts in ((axes.xaxis, (1.0, 2.0, 4.0)), (axes.yaxis, subdivisions)):
        axis.set_major_locator(LogLocator(base=10, subs=parts, numticks=12))
        axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        # Unlabelled ticks between them would take two thirds of the time of a panel.
        axis.set_minor_locator(NullLocator())
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def middle_m(low_m: float, high_m: float) -> float:
    """Middle of a bin of distances on a logarithmic axis. [m]"""
    return float(np.sqrt(low_m * high_m))


@contextmanager
def drawing(size_in: tuple[float, float]) -> Iterator[tuple[Figure, Axes]]:
    """A figure without pyplot, which leaves matplotlib's settings unchanged."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=size_in, layout="constrained" if size_in[1] > 1 else None)
        FigureCanvasSVG(figure)
        figure.patch.set_alpha(0)
        axes = figure.add_subplot()
        axes.patch.set_alpha(0)
        yield figure, axes


def svg_element(figure: Figure, name: str, label: str) -> str:
    """The figure as an element for an HTML page; `name` keeps its ids apart from those of the page's other figures."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"\s+xmlns(:\w+)?=\"[^\"]*\"", "", text).replace("xlink:href", "href")
    text = re.sub(r"\s+(width|height)=\"[\d.]+pt\"", "", text, count=2)
    text = re.sub(r"(\bid=\"|url\(#|href=\"#)", rf"\g<1>{name}-", text).replace(INK, "currentColor")
    role = f'role="img" aria-label="{html.escape(label)}"' if label else 'aria-hidden="true"'
    return text.replace("<svg", f"<svg {role}", 1).strip()


# Of a logarithmic axis: its upper end over its lower one.
_LEAST_SPAN = 4.0

Styles = Mapping[str, MethodStyle]


class Point(NamedTuple):
    """A value over the distances from `low_m` to `high_m`; None is not drawn."""

    low_m: float
    high_m: float
    value: float | None


class DistanceLine(NamedTuple):
    """Values of one method against distance; a dashed line for the second of two kinds."""

    method: str
    points: Sequence[Point]
    is_dashed: bool = False


def overlap_panels(rows: Mapping[str, OverlapRow], styles: Styles) -> list[str]:
    """Success, precision and normalised precision plots of some rows, each a line.

    Returns:
        `<svg>` elements.
    """
    kinds = (
        ("success", "Success: share of overlaps above", "Overlap (IoU)", OVERLAPS),
        ("precisions", "Precision: share of centres within", "Distance of the centres [px]", CENTER_ERRORS_PX),
        ("normalized", "Normalised precision", "Distance of the centres over the box's size", NORMALIZED_ERRORS),
    )
    return [_share_panel(rows, styles, *kind) for kind in kinds]


def distance_lines_panel(name: str, title: str, lines: Sequence[DistanceLine], styles: Styles) -> str:
    """Lines against distance, both axes logarithmic.

    Args:
        name: keeps the element's ids apart from those of others.
        title: above the panel, with the unit.
        lines: in the panel's unit.
        styles: by method.

    Returns:
        An `<svg>` element, or an empty text where no line has a point.
    """
    if not any(point.value for line in lines for point in line.points):
        return ""
    with drawing(_size_in(len({line.method for line in lines}))) as (figure, axes):
        for line in lines:
            # A logarithmic axis cannot show 0.
            known = [(middle_m(p.low_m, p.high_m), p.value) for p in line.points if p.value is not None and p.value > 0]
            if known:
                style = styles[line.method]
                places, values = zip(*known, strict=True)
                dashes = (0, (3, 2)) if line.is_dashed else "solid"
                axes.plot(
                    places,
                    values,
                    color=style.color,
                    marker=style.marker,
                    linestyle=dashes,
                    markersize=3.5 if line.is_dashed else 5,
                    linewidth=1.2,
                )
        _widen(axes)
        finish_distance_axes(axes, title)
        return svg_element(figure, name, f"{title} against distance, by method")


def _widen(axes: Axes) -> None:
    """Widen the axis, so that nearly equal values look equal and the axis has labels."""
    low, high = axes.dataLim.intervaly
    spare = max(1.15, (_LEAST_SPAN * low / high) ** 0.5)
    axes.set_ylim(low / spare, high * spare)


def _share_panel(
    rows: Mapping[str, OverlapRow], styles: Styles, key: str, title: str, label: str, places: Array
) -> str:
    with drawing(_size_in(len(rows))) as (figure, axes):
        for name, row in rows.items():
            style = styles[name]
            axes.plot(
                places, getattr(row, key), color=style.color, marker=style.marker, markevery=0.2, markersize=4.5, lw=1.2
            )
        if key == "precisions":
            axes.axvline(PRECISION_AT_PX, color=INK, linestyle=(0, (4, 2)), linewidth=1.0)
        _finish_share_axes(axes, title, label)
        return svg_element(figure, f"sequence-{key}", f"{title}, by source of the boxes")


def _finish_share_axes(axes: Axes, title: str, label: str) -> None:
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.set_xlabel(label)
    axes.set_xlim(0, None)
    axes.set_ylim(0, 1.02)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _size_in(lines: int) -> tuple[float, float]:
    return PANEL_IN if lines <= FEW_METHODS else LARGE_PANEL_IN
