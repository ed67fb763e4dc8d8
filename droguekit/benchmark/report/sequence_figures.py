"""Panels of the report about sequences: OTB's plots, and errors and times against distance, as inline SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from droguekit.benchmark.report.figures import (
    FEW_METHODS,
    INK,
    LARGE_PANEL_IN,
    PANEL_IN,
    MethodStyle,
    drawing,
    finish_distance_axes,
    middle_m,
    svg_element,
)
from droguekit.benchmark.results.tracking_result import OverlapRow
from droguekit.benchmark.sequences.tracking_overlap import (
    CENTER_ERRORS_PX,
    NORMALIZED_ERRORS,
    OVERLAPS,
    PRECISION_AT_PX,
)
from geometry.se3 import Array

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
        An `<svg>` element, or nothing where no line has a point.
    """
    if not any(point.value for line in lines for point in line.points):
        return ""
    with drawing(_size_in(len({line.method for line in lines}))) as (figure, axes):
        for line in lines:
            # A logarithmic axis has no place for nothing.
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
    """Values that are nearly alike look so, and the axis has numbers to read."""
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
