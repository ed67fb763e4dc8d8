"""Error against distance, drawn as inline SVG that takes the page's ink and needs nothing from outside."""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from droguekit.benchmark.report.number_text import plain_number
from droguekit.benchmark.results.benchmark_result import BenchmarkResult, MethodResult, ReferenceBin

# Mid-tones, our choice: each stands out on white and on black, and neighbours differ in lightness as well as in hue.
_COLORS = (
    *("#1f78c8", "#e0660a", "#12946a", "#c2589c", "#b58900", "#3ba7d6", "#8a63d2", "#d03a3a", "#9a6a3a", "#7f8890"),
    *("#7aa61e", "#e58fb0", "#3d5ba9"),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "p", "*", "d")

# Stands for the page's own text colour while matplotlib draws.
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

# With more methods than this, panels are larger and intervals fainter, or nothing could be told apart.
FEW_METHODS = 6
LARGE_PANEL_IN = (6.6, 5.0)


@dataclass(frozen=True)
class Quantity:
    """What a panel shows.

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
    names = list(result.methods)
    few = len(names) <= FEW_METHODS
    with drawing(PANEL_IN if few else LARGE_PANEL_IN) as (figure, axes):
        styles = method_styles(names)
        # A little apart, so that methods do not cover each other, and all within an eighth of the true distance.
        step = min(1.03, 1.25 ** (1 / len(names)))
        for k, name in enumerate(names):
            shift = step ** (k - (len(names) - 1) / 2)
            _draw_method(axes, result.methods[name], quantity, styles[name], (shift, 1.0 if few else 0.3))
        _draw_bound(axes, result.reference, quantity)
        finish_distance_axes(axes, quantity.title)
        return svg_element(figure, quantity.key, f"{quantity.title} against distance, by method")


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
    axes: Axes, method: MethodResult, quantity: Quantity, style: MethodStyle, place: tuple[float, float]
) -> None:
    """One line; `place` is its shift in distance and the opacity of its intervals."""
    shift, opacity = place
    rows = [(row, row.value(quantity.key)) for row in method.bins]
    # A logarithmic axis has no place for an error of exactly nothing.
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
    )


def _draw_bound(axes: Axes, reference: Sequence[ReferenceBin], quantity: Quantity) -> None:
    places = [(middle_m(b.low_m, b.high_m), getattr(b.bound, quantity.bound_key)) for b in reference if b.bound]
    drawn = [(x, y * quantity.scale) for x, y in places if y > 0]
    if drawn:
        # A single distance has no line: a cross stands for it.
        x, y = zip(*drawn, strict=True)
        axes.plot(x, y, color=INK, linestyle=(0, (4, 2)), linewidth=1.6, marker="+", markersize=5, zorder=5)


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
        axis.set_minor_formatter(NullFormatter())
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def middle_m(low_m: float, high_m: float) -> float:
    """Middle of a bin of distances on a logarithmic axis. [m]"""
    return float(np.sqrt(low_m * high_m))


@contextmanager
def drawing(size_in: tuple[float, float]) -> Iterator[tuple[Figure, Axes]]:
    """A figure of its own, without pyplot and without a trace in matplotlib's settings."""
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
