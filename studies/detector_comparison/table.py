"""The comparison as a table for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any


def comparison_lines(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """One line a detector; the ratio is of CPU times, round by round, to the first one's."""
    first = next(iter(rows))
    yield (
        f"{'detector':<16} {'parameters':>11} {'GFLOPs':>7} {'wall p50':>9} {'p90':>7} {'p99':>7} {'CPU p50':>9} "
        f"{'CPU / ' + first:>14} {'AP50':>8} {'AP':>8}"
    )
    for name, row in rows.items():
        wall = " ".join(f"{time_ms:{width}.1f}" for time_ms, width in zip(row["wall_ms"], (9, 7, 7), strict=True))
        yield (
            f"{name:<16} {row['parameters']:>11,} {row['gflops_per_image']:7.2f} {wall} {row['cpu_ms'][0]:9.1f} "
            f"{row['ratio']:14.2f} {_share(row.get('ap50')):>8} {_share(row.get('ap')):>8}"
        )
    yield "times in ms for a stereo pair, from full-size images to boxes; GFLOPs of one image"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f} %"
