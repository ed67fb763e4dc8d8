"""The paper's Figures 10 and 16 to 19.

Figure 10 is place and size of the drogue in the images of a corpus, Figures 16 to 18 a docking run over the image
number, Figure 19 the bench experiment against distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PixelBox
from droguekit.scoring.report.figures import INK, PANEL_IN, MethodStyle, drawing, svg_element
from droguekit.scoring.report.number_text import plain_number
from geometry.se3 import Array
from studies.paper.docking_experiment import DockingRun
from studies.paper.paper_inputs import source_text
from studies.paper.published_results import (
    ANGLE_LIMIT_DEG,
    POSITION_LIMIT_M,
    TABLE_2,
    Contender,
    PublishedStation,
    style_of,
)
from studies.paper.semi_physical import SemiPhysicalRun, StationErrors

# A blue that is visible on white and on black; its opacity grows with the number of drogues.
_COLOR = "#1f78c8"
_CELLS_ACROSS = 24
_SIZE_BARS = 20
# Size of a panel over the image number. [in]
_SERIES_IN = (4.4, 2.7)

# A few outliers would flatten the curves: where the largest error is that much larger than the 99th percentile, the
# panel ends there and the errors beyond are counted.
_NEARLY_ALL_PERCENTILE = 99.0
_FAR_LARGER = 4.0

# About how many poses of a line have its marker, and how many lines alternate their markers.
_MARKS = 12
_ORDERS = 4


@dataclass(frozen=True, eq=False)
class CorpusBoxes:
    """Visible boxes of a corpus, of both eyes.

    Attributes:
        manifest: of the dataset.
        images, scenes: how many, with and without a drogue.
        size_px: width and height of an image.
        boxes: (N, 4) x, y of the low corner, width, height in pixel-centre coordinates. [px]
        distances_m: (N,) of the drogue. [m]
    """

    manifest: Manifest
    images: int
    scenes: int
    size_px: tuple[int, int]
    boxes: Array
    distances_m: Array

    @property
    def source(self) -> str:
        """What the dataset is called and which engines made it."""
        return source_text(self.manifest)


class _Plane(NamedTuple):
    """What a panel of cells is called, and its axes."""

    name: str
    title: str
    across: str
    upwards: str


def read_corpus(dataset: Location, faults: PairFaults | None = None) -> CorpusBoxes:
    """Read the boxes of every pair.

    Damaged pairs are left out where `faults` counts them.

    Raises:
        ValueError: no such dataset, a record that cannot be read, or no drogue in it.
    """
    data = Dataset(dataset)
    boxes: list[PixelBox] = []
    distances: list[float] = []
    for record in data.records(faults):
        for view in (record.views.left, record.views.right):
            if view.box_visible_xywh_px is not None and record.conditions.distance_m is not None:
                boxes.append(view.box_visible_xywh_px)
                distances.append(record.conditions.distance_m)
    if not boxes:
        raise ValueError(f"{dataset}: shows no drogue in any image")
    camera, counts = data.manifest.recipe.rig.camera, data.manifest.counts
    return CorpusBoxes(
        manifest=data.manifest,
        images=2 * counts.pairs,
        scenes=len(counts.by_scene),
        size_px=(camera.width_px, camera.height_px),
        boxes=np.array(boxes),
        distances_m=np.array(distances),
    )


def place_panel(corpus: CorpusBoxes) -> str:
    """How many drogues have their middle where in the image.

    Returns:
        An `<svg>` element.
    """
    middles = corpus.boxes[:, :2] + corpus.boxes[:, 2:] / 2
    plane = _Plane(
        "place", "Where: drogues by the middle of their box", "Column of the middle [px]", "Row of the middle [px]"
    )
    # Rows count downwards, and the first pixel's edge lies half a pixel before its centre.
    return _cells_panel(corpus, middles, -0.5, plane, is_image=True)


def shape_panel(corpus: CorpusBoxes) -> str:
    """How many drogues have which width and height.

    Returns:
        An `<svg>` element.
    """
    plane = _Plane("shape", "How large: width and height", "Width of the box [px]", "Height of the box [px]")
    return _cells_panel(corpus, corpus.boxes[:, 2:], 0.0, plane, is_image=False)


def size_panel(corpus: CorpusBoxes) -> str:
    """How many drogues there are of each size, logarithmic.

    Returns:
        An `<svg>` element.
    """
    sides = np.sqrt(corpus.boxes[:, 2] * corpus.boxes[:, 3])
    low, high = float(sides.min()), float(sides.max())
    edges = np.geomspace(low, max(high, 1.001 * low) * 1.0001, _SIZE_BARS + 1)
    counts, _ = np.histogram(sides, edges)
    with drawing(PANEL_IN) as (figure, axes):
        axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=_COLOR, linewidth=0)
        axes.set_xscale("log")
        axes.set_xlim(edges[0], edges[-1])
        axes.xaxis.set_major_locator(FixedLocator([5, 10, 20, 50, 100, 200, 500, 1000]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
        axes.set_xlabel("Side of the square with the box's area [px]")
        axes.set_title("How large: drogues by size", fontsize=10.5, loc="left")
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        return svg_element(figure, "figure-10-size", "Number of drogues by size")


def _cells_panel(corpus: CorpusBoxes, points: Array, start: float, plane: _Plane, is_image: bool) -> str:
    """Points of the image's plane, or of sizes up to the image's, counted in square cells."""
    width, height = corpus.size_px
    cells = (_CELLS_ACROSS, round(_CELLS_ACROSS * height / width))
    ends = ((start, start + width), (start, start + height))
    with drawing(PANEL_IN) as (figure, axes):
        _draw_cells(axes, points, [np.linspace(*end, count + 1) for end, count in zip(ends, cells, strict=True)])
        axes.set_xlim(*ends[0])
        axes.set_ylim(*(reversed(ends[1]) if is_image else ends[1]))
        axes.set_aspect("equal")
        axes.set_xlabel(plane.across)
        axes.set_ylabel(plane.upwards)
        axes.set_title(plane.title, fontsize=10.5, loc="left")
        return svg_element(figure, f"figure-10-{plane.name}", f"Number of drogues. {plane.title}")


def _draw_cells(axes: Axes, points: Array, edges: Sequence[Array]) -> None:
    """A cell for each number of points, the more opaque the more there are; empty ones are not drawn."""
    counts, _ = np.histogramdd(points, bins=list(edges))
    most = counts.max()
    for i, j in zip(*np.nonzero(counts), strict=True):
        corner, size = (edges[0][i], edges[1][j]), (np.diff(edges[0])[i], np.diff(edges[1])[j])
        # The square root lets single ones be seen.
        opacity = 0.15 + 0.85 * float(np.sqrt(counts[i, j] / most))
        axes.fill(
            corner[0] + size[0] * np.array([0, 1, 1, 0]),
            corner[1] + size[1] * np.array([0, 0, 1, 1]),
            color=_COLOR,
            alpha=opacity,
            linewidth=0,
        )
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)


class SeriesQuantity(NamedTuple):
    """A component of the pose.

    Attributes:
        column: in the arrays of a `Run`.
        name: for ids.
        axis: what it is, with its unit.
        scale: from the arrays' unit to the shown one of an error.
        limit: that the paper claims for its errors, in the shown unit.
    """

    column: int
    name: str
    axis: str
    unit: str
    scale: float
    limit: float


X, Y, Z, PITCH, YAW = (
    SeriesQuantity(0, "x", "X, to the right", "mm", 1e3, 1e3 * POSITION_LIMIT_M),
    SeriesQuantity(1, "y", "Y, down", "mm", 1e3, 1e3 * POSITION_LIMIT_M),
    SeriesQuantity(2, "z", "Z, depth", "mm", 1e3, 1e3 * POSITION_LIMIT_M),
    SeriesQuantity(3, "pitch", "Pitch", "deg", 1.0, ANGLE_LIMIT_DEG),
    SeriesQuantity(4, "yaw", "Yaw", "deg", 1.0, ANGLE_LIMIT_DEG),
)


def error_series(figure_name: str, run: DockingRun, contenders: Sequence[Contender], quantity: SeriesQuantity) -> str:
    """Signed errors of some methods over the image number; what the paper claims as a dotted line where it fits in.

    Args:
        figure_name: that keeps ids apart from those of other figures.
        run: the sequence.
        contenders: methods to draw, the first one on top.
        quantity: which component.

    Returns:
        An `<svg>` element.
    """
    with drawing(_SERIES_IN) as (figure, axes):
        shown = [run.errors[contender.method][:, quantity.column] * quantity.scale for contender in contenders]
        reach = _reach(shown)
        outside = sum(int(np.count_nonzero(np.abs(values) > reach)) for values in shown)
        for order, (contender, values) in enumerate(zip(contenders, shown, strict=True)):
            _draw_series(axes, run, values, style_of(contender.method), order)
        axes.axhline(0, color=INK, linewidth=0.7)
        if quantity.limit <= reach:
            for side in (-quantity.limit, quantity.limit):
                axes.axhline(side, color=INK, linestyle=(0, (1, 2)), linewidth=1.2)
        axes.set_ylim(-reach, reach)
        _finish(axes, run, f"{quantity.axis}: error [{quantity.unit}]{_outside_text(outside, 'larger not shown')}")
        names = ", ".join(contender.method for contender in contenders)
        label = f"Error in {quantity.axis} over the image number, of {names}"
        return svg_element(figure, f"{figure_name}-{quantity.name}", label)


def truth_series(figure_name: str, run: DockingRun, contenders: Sequence[Contender], quantity: SeriesQuantity) -> str:
    """True and estimated component over the image number; one of the first three.

    Returns:
        An `<svg>` element.
    """
    with drawing(_SERIES_IN) as (figure, axes):
        truth = run.truth[:, quantity.column]
        axes.plot(run.numbers, truth, color=INK, linewidth=7, alpha=0.2, solid_capstyle="round")
        # By the truth: a mistaken pose may lie anywhere.
        low, high = float(truth.min()), float(truth.max())
        margin = max(0.12 * (high - low), 1e-3)
        outside = 0
        for order, contender in enumerate(contenders):
            values = truth + run.errors[contender.method][:, quantity.column]
            outside += int(np.count_nonzero((values < low - margin) | (values > high + margin)))
            _draw_series(axes, run, values, style_of(contender.method), order)
        axes.set_ylim(low - margin, high + margin)
        _finish(axes, run, f"{quantity.axis} [m]{_outside_text(outside, 'outside')}")
        label = f"{quantity.axis}, true and estimated, over the image number"
        return svg_element(figure, f"{figure_name}-{quantity.name}", label)


def length_series(figure_name: str, run: DockingRun, contenders: Sequence[Contender]) -> str:
    """Length of the position error over the image number, logarithmic, so that all methods can be seen at once.

    Returns:
        An `<svg>` element.
    """
    with drawing(_SERIES_IN) as (figure, axes):
        for order, contender in enumerate(contenders):
            lengths = 1e3 * np.linalg.norm(run.errors[contender.method][:, :3], axis=1)
            _draw_series(axes, run, np.where(lengths > 0, lengths, np.nan), style_of(contender.method), order)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(base=10, numticks=12))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.yaxis.set_minor_locator(NullLocator())
        _finish(axes, run, "Length of the position error [mm], logarithmic")
        label = "Length of the position error over the image number, logarithmic"
        return svg_element(figure, f"{figure_name}-length", label)


def _draw_series(axes: Axes, run: DockingRun, values: Array, style: MethodStyle, order: int) -> None:
    """A line with gaps where there is no pose, or no pair; single poses are dots, and some have the method's marker.

    Args:
        axes: to draw on.
        run: the sequence.
        values: (N,) NaN where there is no pose.
        style: of the method.
        order: its place among the drawn ones; the first one is on top, and markers of no two are at the same numbers.
    """
    places = np.arange(run.numbers[0], run.numbers[-1] + 1)
    whole = np.full(len(places), np.nan)
    whole[run.numbers - run.numbers[0]] = values
    axes.plot(places, whole, color=style.color, linewidth=0.9, zorder=10 - order)
    seen = np.isfinite(np.concatenate([[np.nan], whole, [np.nan]]))
    alone = seen[1:-1] & ~seen[:-2] & ~seen[2:]
    axes.plot(places[alone], whole[alone], ".", color=style.color, markersize=3, zorder=10 - order)
    given = np.flatnonzero(seen[1:-1])
    step = max(len(places) // _MARKS, _ORDERS)
    marked = given[order * step // _ORDERS :: step]
    axes.plot(places[marked], whole[marked], style.marker, color=style.color, markersize=4.5, zorder=10 - order)


def _outside_text(count: int, what: str) -> str:
    return f", {count} {what}" if count else ""


def _reach(series: Sequence[Array]) -> float:
    """Half the height of a panel: all errors, or nearly all of each method."""
    sizes = [np.abs(values[np.isfinite(values)]) for values in series if np.isfinite(values).any()]
    most = max((float(size.max()) for size in sizes), default=0.0)
    nearly = max((float(np.percentile(size, _NEARLY_ALL_PERCENTILE)) for size in sizes), default=0.0)
    return max(1.06 * most if most <= _FAR_LARGER * nearly else 1.25 * nearly, 1e-9)


def _finish(axes: Axes, run: DockingRun, title: str) -> None:
    axes.set_title(title, fontsize=10.5, loc="left")
    axes.set_xlabel("Image number")
    axes.set_xlim(run.numbers[0] - 0.5, run.numbers[-1] + 0.5)
    if axes.get_yscale() == "linear":
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    _grid(axes)


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
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_title(shown.title, fontsize=10.5, loc="left")
        axes.set_xlabel("Distance [m]")
        _grid(axes)
        return svg_element(figure, f"{anchor}-{axis}", shown.label)


def axis_errors(errors: StationErrors, axis: Axis) -> Array:
    """(S,) mean size of the errors along an axis. [m]"""
    return {"x": errors.x_m, "y": errors.y_m, "z": errors.z_m}[axis]


def published_row(markers: int) -> PublishedStation | None:
    """The published row of the paper's own method with that number of markers."""
    return next((row for row in TABLE_2 if row.markers == markers), None)


def _grid(axes: Axes) -> None:
    axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
