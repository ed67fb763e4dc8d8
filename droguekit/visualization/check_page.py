"""The check of a recipe as one self-contained HTML page: pictures near and far, and predictions against distance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from droguekit.visualization.plan_page import PlanFigure, draw_figure, label_logarithmic, write_figure_page

_COLORS = {"day": "#c98a00", "dusk": "#7b4fa3", "night": "#1f3d7a", "map": "#3a7d44"}
_BRIGHTEST_PERCENT = 99.7


class Prediction(Protocol):
    """One row of a check; see `droguekit.workflows.recipe_check.MarkerPrediction`."""

    @property
    def light(self) -> str:
        """Name of the light."""
        ...

    @property
    def distance_m(self) -> float:
        """Of the drogue. [m]"""
        ...


@dataclass(frozen=True, eq=False)
class DroguePicture:
    """The drogue's surroundings in a rendered left image.

    Attributes:
        distance_m: of the drogue.
        image: (H, W) or (H, W, 3), proportional to light or not.
    """

    distance_m: float
    image: NDArray[np.uint8] | NDArray[np.uint16]


def write_check_page(
    name: str,
    rows: Sequence[Prediction],
    pictures: Sequence[DroguePicture],
    lines: Sequence[str],
    out: Path,
    advice: Sequence[str] = (),
) -> None:
    """Write the page; it is replaced as a whole, or not at all.

    Args:
        name: of the recipe.
        rows: predictions, by light and then from near to far.
        pictures: rendered ones, from near to far; may be none.
        lines: printed by the command.
        out: file to write.
        advice: what will fail, told at the top, as a narrow screen cuts long lines.

    Raises:
        OSError: it cannot be written.
    """
    description = (
        "Computed from the recipe's light, exposure and sensor, with the drogue on the cameras' axis. "
        "The pictures are rendered, and stretched to their brightest parts."
    )
    write_figure_page(f"What to expect of {name}", description, _figures(rows, pictures), lines, out, advice)


def _figures(rows: Sequence[Prediction], pictures: Sequence[DroguePicture]) -> Iterator[PlanFigure]:
    for picture in pictures:
        yield draw_figure(
            f"The drogue at {picture.distance_m:.3g} m",
            "Left image, pixel by pixel, in the light of the recipe's first scene.",
            lambda axes, shown=picture: _picture(axes, shown),  # type: ignore[misc]
        )
    yield draw_figure(
        "Radius of a marker", "Fits need 0.3 px.", lambda axes: _curve(axes, rows, "radius_px", "px", 0.3)
    )
    yield draw_figure(
        "Light of a marker over the noise",
        "Below 5 deviations a marker is not told from noise.",
        lambda axes: _curve(axes, rows, "snr", "deviations", 5.0),
    )
    yield draw_figure(
        "Error of a marker's centre",
        "Cramer-Rao bound, one axis; clipped pixels tell nothing.",
        lambda axes: _curve(axes, rows, "centroid_sigma_px", "px"),
    )
    yield draw_figure(
        "Error of the position along the line of sight",
        "Cramer-Rao bound of all markers in both eyes.",
        lambda axes: _curve(axes, rows, "z_sigma_m", "mm", factor=1e3),
    )
    yield draw_figure(
        "Error of the position across the line of sight",
        "Cramer-Rao bound of all markers in both eyes.",
        lambda axes: _curve(axes, rows, "x_sigma_m", "mm", factor=1e3),
    )
    yield draw_figure(
        "Error of pitch",
        "Cramer-Rao bound head on, without the hub, where the tilt is known worst.",
        lambda axes: _curve(axes, rows, "pitch_sigma_deg", "deg"),
    )


def _picture(axes: Axes, picture: DroguePicture) -> None:
    image = picture.image.astype(np.float64)
    low, high = np.percentile(image, [0.1, _BRIGHTEST_PERCENT])
    shown = np.clip((image - low) / max(high - low, 1.0), 0, 1)
    axes.imshow(shown, cmap="gray", interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


def _curve(
    axes: Axes, rows: Sequence[Prediction], key: str, unit: str, limit: float | None = None, factor: float = 1.0
) -> None:
    for light in dict.fromkeys(row.light for row in rows):
        own = [(row.distance_m, getattr(row, key)) for row in rows if row.light == light]
        known = [(distance_m, factor * value) for distance_m, value in own if value is not None and value > 0]
        if known:
            axes.plot(*zip(*known, strict=True), "o-", markersize=4, color=_COLORS.get(light), label=light)
    if limit is not None:
        axes.axhline(limit, color="#b03a2e", linewidth=1)
    axes.set(xscale="log", yscale="log", xlabel="Distance [m]", ylabel=f"[{unit}]")
    label_logarithmic(axes.xaxis, *axes.get_xlim())
    label_logarithmic(axes.yaxis, *axes.get_ylim())
    axes.grid(True, alpha=0.3)
    if axes.has_data() and axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False)
