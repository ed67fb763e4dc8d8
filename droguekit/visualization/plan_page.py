"""A plan as one self-contained HTML page with plots of families, distances, sizes and places."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.recipe.recipe import Recipe
from droguekit.batch.recipe_plan import RecipePlan, check_places, check_sizes, distance_share
from droguekit.scoring.report.html_page import page_template
from geometry.se3 import Array

# A phone shows a picture 330 px wide, and its letters are to have 9 px there.
PANEL_IN = (5.0, 3.8)
DPI = 160
_BAR, _LAW = "#7aa9d8", "#b03a2e"
_BINS = 24
_CELL_PX = 40
# Labels within a decade, by the largest ratio of an axis's limits; axes of a shorter range have even ones.
_LABELS = (
    (12.0, (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)),
    (200.0, (1.0, 2.0, 5.0)),
    (3000.0, (1.0, 3.0)),
    (np.inf, (1.0,)),
)
_SHORT_RANGE = 3.0
_MOST_STATION_LABELS = 8


@dataclass(frozen=True)
class PlanFigure:
    """One picture.

    Attributes:
        title: what it shows.
        caption: how to read it.
        png: the file's contents.
    """

    title: str
    caption: str
    png: bytes


def plan_figures(recipe: Recipe, planned: RecipePlan) -> Iterator[PlanFigure]:
    """The pictures of a plan; without drogues there are none of distances and boxes."""
    if planned.by_family:
        yield draw_figure(
            "Pairs by family of conditions",
            "Every family has its share of the scenes, and every scene about as many pairs.",
            lambda axes: _families(axes, planned),
        )
    drawn = planned.drawn
    if not np.isfinite(drawn.distances_m).any():
        return
    of = "" if len(drawn.indices) == recipe.frames.count else f" Of {len(drawn.indices)} drawn pairs."
    yield draw_figure(
        "Distance of the drogue",
        f"Planar distance of the rim's centre from the left camera.{_law_note(recipe)}{of}",
        lambda axes: _distances(axes, recipe, planned),
    )
    yield draw_figure(
        "Size of the drogue's box",
        f"Side of the square with the area of the whole drogue's box, left image.{_chance(recipe, planned)}{of}",
        lambda axes: _sizes(axes, recipe, planned),
    )
    yield draw_figure(
        "Place of the drogue's box",
        f"Middles of the boxes in the left image, counted in equal cells.{_place_note(recipe, planned)}{of}",
        lambda axes: _places(axes, recipe, planned),
    )


def _draws_distance(recipe: Recipe) -> bool:
    return (
        recipe.distance.law != "stations"
        and recipe.sequence is None
        and recipe.distance.low_m != recipe.distance.high_m
    )


def _law_note(recipe: Recipe) -> str:
    return " Line: what the recipe intends." if _draws_distance(recipe) else ""


def _place_note(recipe: Recipe, planned: RecipePlan) -> str:
    places = check_places(planned.drawn, recipe.rig.camera)
    if places is None:
        return ""
    chance = f" Chi-square against that law: p = {places.p_value:.2g}." if places.degrees else ""
    return (
        " All places at which both cameras see all of the drogue are equally likely: a near one has little room, and a "
        f"margin stays empty.{chance}"
    )


def _chance(recipe: Recipe, planned: RecipePlan) -> str:
    sizes = check_sizes(planned.drawn, recipe)
    if sizes is None or not sizes[0].degrees:
        return ""
    return f" Line: what the recipe intends; chi-square against it: p = {sizes[0].p_value:.2g}."


def _families(axes: Axes, planned: RecipePlan) -> None:
    names = list(planned.by_family)
    pairs = [pairs for _, pairs in planned.by_family.values()]
    bars = axes.barh(names, pairs, color=_BAR)
    labels = [f" {count} in {scenes} scenes" for scenes, count in planned.by_family.values()]
    axes.bar_label(bars, labels, fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(0, max(pairs) * 1.4)
    axes.set_xlabel("Stereo pairs")
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def _distances(axes: Axes, recipe: Recipe, planned: RecipePlan) -> None:
    distances = planned.drawn.distances_m[np.isfinite(planned.drawn.distances_m)]
    law = recipe.distance
    axes.set_xlabel("Distance [m]")
    if law.stations_m is not None:
        stations, counts = np.unique(distances.round(9), return_counts=True)
        places = np.arange(len(stations))
        axes.bar(places, counts, color=_BAR)
        labelled = places[:: -(-len(stations) // _MOST_STATION_LABELS)]
        axes.set_xticks(labelled, [f"{stations[place]:g}" for place in labelled])
        _count_pairs(axes, "Stereo pairs at each station")
        return
    edges = _log_edges(distances)
    axes.stairs(np.histogram(distances, edges)[0], edges, color=_BAR, fill=True)
    if _draws_distance(recipe):
        axes.stairs(np.diff(distance_share(law, edges)) * len(distances), edges, color=_LAW, linewidth=1.6)
    _logarithmic(axes)


def _sizes(axes: Axes, recipe: Recipe, planned: RecipePlan) -> None:
    sides = planned.drawn.sides_px[np.isfinite(planned.drawn.sides_px)]
    axes.set_xlabel("Side of the box [px]")
    sizes = check_sizes(planned.drawn, recipe)
    if sizes is None:
        edges = _log_edges(sides)
        axes.stairs(np.histogram(sides, edges)[0], edges, color=_BAR, fill=True)
    else:
        check, edges = sizes
        axes.stairs(check.counts, edges, color=_BAR, fill=True)
        axes.stairs(check.expected, edges, color=_LAW, linewidth=1.6)
    _logarithmic(axes)


def _places(axes: Axes, recipe: Recipe, planned: RecipePlan) -> None:
    camera = recipe.rig.camera
    centers = planned.drawn.centers_px[np.isfinite(planned.drawn.centers_px).all(axis=1)]
    edges = [np.linspace(-0.5, n - 0.5, max(4, n // _CELL_PX) + 1) for n in (camera.width_px, camera.height_px)]
    counts = np.histogramdd(centers, edges)[0].T
    image = axes.pcolormesh(edges[0], edges[1], np.where(counts > 0, counts, np.nan), cmap="viridis", vmin=0)
    whole = MaxNLocator(5, integer=True)
    axes.figure.colorbar(image, ax=axes, label="Stereo pairs in a cell", shrink=0.8, ticks=whole)
    axes.set(aspect="equal", xlim=(-0.5, camera.width_px - 0.5), ylim=(camera.height_px - 0.5, -0.5))
    axes.set_xlabel("u, to the right [px]")
    axes.set_ylabel("v, down [px]")


def _log_edges(values: Array) -> Array:
    low, high = float(values.min()), float(values.max())
    return np.geomspace(low * (1 - 1e-9), max(high, low * 1.01) * (1 + 1e-9), _BINS + 1)


def _count_pairs(axes: Axes, label: str) -> None:
    axes.set_ylabel(label)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def _logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    _count_pairs(axes, "Stereo pairs in a bin")
    label_logarithmic(axes.xaxis, *axes.get_xlim())


def label_logarithmic(axis: Axis, low: float, high: float) -> None:
    """Labels that an axis of any range has several of.

    Args:
        axis: with a logarithmic scale.
        low, high: its limits.
    """
    if high < _SHORT_RANGE * low:
        axis.set_major_locator(MaxNLocator(6))
    else:
        subs = next(subs for ratio, subs in _LABELS if high < ratio * low)
        axis.set_major_locator(LogLocator(base=10, subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def draw_figure(title: str, caption: str, draw: Callable[[Axes], None]) -> PlanFigure:
    """A plot in a page's style, drawn without pyplot and with matplotlib's settings left as they were."""
    with matplotlib.rc_context({"font.family": "sans-serif", "font.size": 10.0}):
        figure = Figure(figsize=PANEL_IN, dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        axes.set_title(title, loc="left", fontsize=11.5)
        draw(axes)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        stream = io.BytesIO()
        figure.savefig(stream, format="png", metadata={"Software": None})
    return PlanFigure(title, caption, stream.getvalue())


def write_plan_page(recipe: Recipe, planned: RecipePlan, lines: Sequence[str], out: Path) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        recipe: of the plan.
        planned: what it will make.
        lines: printed by the command.
        out: file to write.

    Raises:
        OSError: it cannot be written.
    """
    title = f"What {recipe.name} will make"
    write_figure_page(title, recipe.description, plan_figures(recipe, planned), lines, out)


def write_figure_page(
    title: str,
    description: str,
    figures: Iterable[PlanFigure],
    lines: Sequence[str],
    out: Path,
    advice: Sequence[str] = (),
) -> None:
    """Write a page with pictures and the lines that a command prints; it is replaced as a whole, or not at all.

    Args:
        title: of the page.
        description: a sentence below it.
        figures: the pictures.
        lines: printed by the command.
        out: file to write.
        advice: what will fail and what to change, told before the pictures.

    Raises:
        OSError: it cannot be written.
    """
    shown = [
        {"title": figure.title, "caption": figure.caption, "data": base64.b64encode(figure.png).decode("ascii")}
        for figure in figures
    ]
    template = page_template("plan_page.html.j2", __package__)
    page = template.render(
        title=title, description=description, advice=advice, figures=shown, lines="\n".join(lines) + "\n"
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomic(out, page)
