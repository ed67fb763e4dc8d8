"""A picture of the position error of all estimators over distance."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from datasets_manifest.atomic import write_bytes_atomic
from studies.learned_pose.estimators import OURS, OURS_CPNP, OURS_MONO, SIMCC, SIMCC_STEREO, YOLO
from studies.learned_pose.position_scores import BINS_M, PairScores, in_bin, percentile

PLOTTED = (YOLO, SIMCC, SIMCC_STEREO, OURS_CPNP, OURS_MONO, OURS)
_INCHES, _DPI = (7.2, 5.0), 110
_STYLES = {
    YOLO: ("#e07a1f", "s"),
    SIMCC: ("#3d5a80", "^"),
    SIMCC_STEREO: ("#2a9d8f", "v"),
    OURS_CPNP: ("#8e6bbf", "D"),
    OURS_MONO: ("#d98880", "o"),
    OURS: ("#c8102e", "o"),
}
_BOUND = "0.35"
_TICKS_M = (2, 3, 5, 10, 20, 30, 40)


def write_error_plot(pairs: Sequence[PairScores], file: Path) -> None:
    """Draw every pose's error as a dot and each bin's median as a line, and the bound.

    Args:
        pairs: of all distances, with the plotted estimators.
        file: PNG.

    Raises:
        OSError: it cannot be written.
    """
    figure = Figure(figsize=_INCHES, dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    groups = [group for low, high in BINS_M if (group := in_bin(pairs, low, high))]
    middles_m = [percentile([pair.distance_m for pair in group], 50) for group in groups]
    for name in PLOTTED:
        color, marker = _STYLES[name]
        dots = [(pair.distance_m, 100 * score.position_m) for pair in pairs for score in pair.scores[name]]
        # A pose without error has no place on a logarithmic axis, nor has one that is missing.
        shown = [(x, y) for x, y in dots if 0 < y < math.inf]
        axes.scatter([x for x, _ in shown], [y for _, y in shown], s=5, color=color, alpha=0.35, linewidths=0)
        medians = [
            percentile([100 * s.position_m for pair in group for s in pair.scores[name]], 50) for group in groups
        ]
        axes.plot(
            middles_m, medians, color=color, marker=marker, markersize=5, linewidth=1.6, label=name.replace("`", "")
        )
    bounds = [percentile([100 * pair.bound_m for pair in group], 50) for group in groups]
    axes.plot(middles_m, bounds, "--", color=_BOUND, linewidth=1.4, label="stereo bound")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(_TICKS_M, [str(tick) for tick in _TICKS_M])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("distance [m]")
    axes.set_ylabel("position error [cm]")
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="upper left", frameon=False)
    picture = io.BytesIO()
    canvas.print_png(picture)
    write_bytes_atomic(file, picture.getvalue())
