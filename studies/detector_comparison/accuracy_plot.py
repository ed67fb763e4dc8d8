"""A picture of the detectors' accuracy against their time, and of those that no other beats in both."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, ScalarFormatter

from datasets_manifest.atomic import write_bytes_atomic

_INCHES, _DPI = (7.2, 4.6), 110
_OURS, _THEIRS, _FRONT = "#c8102e", "#3d5a80", "#8a96a3"
_TICKS_MS = tuple(base * 10**power for power in range(-1, 5) for base in (1, 2, 5))


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points of which no other is both as quick and as accurate, quickest first.

    Args:
        points: time and accuracy of each; of equal points the first stays.
    """
    order = sorted(range(len(points)), key=lambda index: (points[index][0], -points[index][1]))
    front = list[int]()
    for index in order:
        if not front or points[index][1] > points[front[-1]][1]:
            front.append(index)
    return front


def write_accuracy_plot(rows: Mapping[str, Mapping[str, Any]], peers: Collection[str], file: Path) -> None:
    """Draw AP and AP50 of each detector over its processor time of a pair.

    Args:
        rows: `ap` and `ap50` from 0 to 1, and `cpu_ms` with the median first, by the detector's name.
        peers: names of the detectors of other projects.
        file: PNG.

    Raises:
        OSError: it cannot be written.
    """
    figure = Figure(figsize=_INCHES, dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    times_ms = [float(row["cpu_ms"][0]) for row in rows.values()]
    for axes, key, title in zip(figure.subplots(1, 2, sharex=True), ("ap", "ap50"), ("AP", "AP50"), strict=True):
        shares = [100 * float(row[key]) for row in rows.values()]
        front = pareto_front(list(zip(times_ms, shares, strict=True)))
        axes.plot(
            [times_ms[index] for index in front], [shares[index] for index in front], "--", color=_FRONT, linewidth=1
        )
        for name, time_ms, share in zip(rows, times_ms, shares, strict=True):
            is_peer = name in peers
            axes.plot(time_ms, share, "s" if is_peer else "o", color=_THEIRS if is_peer else _OURS)
            # Names of ours above, theirs below: the two often stand side by side.
            place = {"xytext": (0, -13 if is_peer else 6), "textcoords": "offset points", "ha": "center"}
            axes.annotate(name, (time_ms, share), fontsize=8, **place)
        axes.set_xscale("log")
        axes.set_xticks([tick for tick in _TICKS_MS if min(times_ms) / 2 < tick < 2 * max(times_ms)])
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_locator(NullLocator())
        axes.margins(0.18)
        axes.set_title(f"{title} [%]", fontsize=10)
        axes.set_xlabel("processor time of a pair [ms]")
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
    picture = io.BytesIO()
    canvas.print_png(picture)
    write_bytes_atomic(file, picture.getvalue())
