"""The bench experiment against distance, as the paper's Figure 19 shows it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from droguekit.benchmark.report.figures import INK, PANEL_IN, drawing, svg_element
from droguekit.benchmark.report.number_text import plain_number
from geometry.se3 import Array
from studies.paper.contenders import style_of
from studies.paper.published import TABLE_2, PublishedStation
from studies.paper.semi_physical import SemiPhysicalRun, StationErrors

Axis = Literal["x", "y", "z"]
AXES: tuple[Axis, ...] = ("x", "y", "z")


class _Shown(NamedTuple):
    """What a panel shows."""

    title: str
    label: str


_TITLES: dict[Axis, _Shown] = {
    "x": _Shown("X: mean size of the error [mm]", "Mean error in X against distance"),
    "y": _Shown("Y: mean size of the error [mm]", "Mean error in Y against distance"),
    "z": _Shown("Z against the reading: mean size of the error [mm]", "Mean error in Z against distance"),
}


def measured_panel(run: SemiPhysicalRun, anchor: str) -> str:
    """Mean measured depth against the mean reading at each station; equality as a pale line.

    Args:
        run: the experiment.
        anchor: of the figure, that keeps ids apart.

    Returns:
        An `<svg>` element.
    """
    with drawing(PANEL_IN) as (figure, axes):
        axes.plot(run.stations_m, run.stations_m, color=INK, linewidth=5, alpha=0.28, solid_capstyle="round")
        for order, contender in enumerate(run.contenders):
            style, errors = style_of(contender.method), run.methods[contender.method]
            axes.plot(
                errors.reading_m,
                errors.measured_m,
                style.marker,
                color=style.color,
                markersize=4 + 1.5 * order,
                markerfacecolor="none",
                zorder=10 - order,
            )
        axes.set_title("Z: measured distance [m]", fontsize=10.5, loc="left")
        axes.set_xlabel("Distance by the rangefinder [m]")
        _grid(axes)
        return svg_element(figure, f"{anchor}-measured", "Measured distance against the rangefinder's")


def station_panel(run: SemiPhysicalRun, anchor: str, axis: Axis) -> str:
    """Mean errors of every method at each station, logarithmic; the paper's own bound as a dotted line.

    Returns:
        An `<svg>` element.
    """
    shown = _TITLES[axis]
    with drawing(PANEL_IN) as (figure, axes):
        for order, contender in enumerate(run.contenders):
            style = style_of(contender.method)
            errors = 1e3 * axis_errors(run.methods[contender.method], axis)
            axes.plot(
                run.stations_m,
                np.where(errors > 0, errors, np.nan),
                color=style.color,
                marker=style.marker,
                markersize=5,
                linewidth=1.2,
                zorder=10 - order,
            )
        published = published_row(run.markers)
        if published is not None:
            bound_m = {"x": published.x_m, "y": published.y_m, "z": published.z_fraction * run.stations_m}[axis]
            bound_mm = np.broadcast_to(1e3 * np.asarray(bound_m), run.stations_m.shape)
            axes.plot(run.stations_m, bound_mm, color=INK, linestyle=(0, (1, 2)), linewidth=1.4)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(base=10, numticks=12))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_title(shown.title, fontsize=10.5, loc="left")
        axes.set_xlabel("Distance [m]")
        _grid(axes)
        return svg_element(figure, f"{anchor}-{axis}", shown.label)


def axis_errors(errors: StationErrors, axis: Axis) -> Array:
    """(S,) mean size of the errors along an axis. [m]"""
    return {"x": errors.x_m, "y": errors.y_m, "z": errors.z_m}[axis]


def published_row(markers: int) -> PublishedStation | None:
    """What the paper prints of its own method with so many markers."""
    return next((row for row in TABLE_2 if row.markers == markers), None)


def _grid(axes: Axes) -> None:
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
