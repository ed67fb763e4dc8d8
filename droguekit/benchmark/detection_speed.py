"""Accuracy of detectors against their speed, with those of the seed paper, as inline SVG in the style of `figures`."""

from __future__ import annotations

from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator, PercentFormatter

from droguekit.benchmark.detection_published import PUBLISHED_DETECTORS
from droguekit.benchmark.detection_result import DetectionResult
from droguekit.benchmark.figures import INK, PANEL_IN, drawing, method_styles, svg_element
from droguekit.benchmark.number_text import plain_number


def is_timed(result: DetectionResult) -> bool:
    """Whether there is anything to show: a detector that was run for this result."""
    return any(detector.times is not None for detector in result.detectors.values())


def speed_panel(result: DetectionResult) -> str:
    """AP50 of every detector that was timed against the time of an image; published ones are hollow and named.

    Returns:
        An `<svg>` element.
    """
    with drawing(PANEL_IN) as (figure, axes):
        for row in PUBLISHED_DETECTORS:
            axes.plot(1e3 * row.image_s, row.ap50, "o", markersize=5, markerfacecolor="none", markeredgecolor=INK)
            axes.annotate(row.name, (1e3 * row.image_s, row.ap50), (4, 4), textcoords="offset points", fontsize=7)
        styles = method_styles(list(result.detectors))
        for name, detector in result.detectors.items():
            if detector.times is not None and detector.overall.ap50 is not None:
                style = styles[name]
                image_ms = detector.times.wall_ms / 2
                axes.plot(image_ms, detector.overall.ap50, style.marker, color=style.color, markersize=7)
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        # Room for the names to the right of the slowest.
        axes.set_xlim(low / 1.1, high * 1.6)
        axes.xaxis.set_major_locator(FixedLocator([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("Time of an image [ms]")
        axes.set_title("AP at overlap 0.5 (hollow: published, other data)", fontsize=10.5, loc="left")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=1))
        axes.grid(True, color=INK, alpha=0.15, linewidth=0.6)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
        return svg_element(figure, "speed", "AP50 against time of an image, by detector, and of published ones")
