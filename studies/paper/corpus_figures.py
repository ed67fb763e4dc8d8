"""Position and size of the drogue in the images of a corpus, as in the paper's Figure 10."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from datasets_manifest.storage.manifest import Manifest
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location
from datasets_manifest.types.records import PixelBox
from droguekit.benchmark.report.figures import INK, PANEL_IN, drawing, svg_element
from droguekit.benchmark.report.number_text import plain_number
from geometry.se3 import Array
from studies.paper.paper_inputs import source_text

# A blue that is visible on white and on black; its opacity grows with the number of drogues.
_COLOR = "#1f78c8"
_CELLS_ACROSS = 24
_SIZE_BARS = 20


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


def read_corpus(dataset: Location) -> CorpusBoxes:
    """Read the boxes of every pair.

    Raises:
        ValueError: no such dataset, a record that cannot be read, or no drogue in it.
    """
    data = Dataset(dataset)
    boxes: list[PixelBox] = []
    distances: list[float] = []
    for index in data.frame_indices:
        record = data.record(index)
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
