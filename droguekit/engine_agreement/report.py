"""The agreement on paper: a table of text, the numbers as JSON, and pictures of what differs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from droguekit.engine_agreement.agreement import Bar, ComparedFrame, part_ratios
from droguekit.engine_agreement.measures import luminance
from droguekit.engine_agreement.plates import PlateLight

# A difference of a fortieth of the picture's white fills the scale from middle grey to black or white.
_DIFFERENCE_SCALE = 40.0
_MARGIN_PX = 12


def frame_row(compared: ComparedFrame) -> dict[str, Any]:
    """The figures of one frame."""
    agreement = compared.agreement
    label, one, other = np.moveaxis(agreement.centroids_px, 1, 0)
    return {
        "family": compared.paired.family,
        "distance_m": compared.paired.distance_m,
        "samples_per_px": compared.paired.settings.samples_per_px,
        "markers": len(label),
        "centroid_rms_px": _rms(one - other),
        "first_label_rms_px": _rms(one - label),
        "second_label_rms_px": _rms(other - label),
        "drogue_iou": agreement.drogue_iou,
        "rib_distance_px": agreement.rib_distance_px,
        "first_cpu_s": compared.one.cpu_s,
        "second_cpu_s": compared.other.cpu_s,
        "first_noise": compared.one.plain.monte_carlo_noise_fraction,
        "second_noise": compared.other.plain.monte_carlo_noise_fraction,
        "cost_ratio": compared.cost_ratio,
        "part_ratios": part_ratios([agreement]),
    }


def table_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """One line a frame."""
    head = f"{'family':<18}{'m':>5}{'spp':>5}{'centroids':>11}{'1st-label':>11}{'2nd-label':>11}"
    lines = [head + f"{'IoU':>9}{'ribs':>6}{'cpu 1st':>9}{'cpu 2nd':>9}{'cost x':>8}  parts 2nd/1st"]
    for row in rows:
        ratios = row["part_ratios"]
        lines.append(
            "{family:<18}{distance_m:5g}{samples_per_px:5d}{centroid_rms_px:11.4f}{first_label_rms_px:11.4f}"
            "{second_label_rms_px:11.4f}{drogue_iou:9.5f}{rib_distance_px:6.2f}{first_cpu_s:9.2f}{second_cpu_s:9.2f}"
            "{cost_ratio:8.1f}  ".format(**row)
            + " ".join(f"{name} {ratio:.3f}" for name, ratio in ratios.items())
        )
    return lines


def bar_lines(bars: Sequence[Bar]) -> list[str]:
    """One line a bar."""
    return [
        f"{'reached' if bar.reached else 'MISSED ':<8} {bar.name}: {bar.value:.5f} "
        f"({'at least' if bar.at_least else 'at most'} {bar.limit:g})"
        for bar in bars
    ]


def plate_lines(plates: Sequence[PlateLight]) -> list[str]:
    """One line a plate."""
    return [
        f"plate pitch {plate.pitch_deg:+.0f} yaw {plate.yaw_deg:+.0f} deg: {plate.one_lux:.0f} lx and "
        f"{plate.other_lux:.0f} lx, ratio {plate.ratio:.4f}; by integral {plate.integral_lux:.0f} lx"
        for plate in plates
    ]


def write_json(out: Path, rows: Sequence[dict[str, Any]], bars: Sequence[Bar], plates: Sequence[PlateLight]) -> None:
    """All figures as `agreement.json`."""
    content = {
        "schema": 1,
        "bars": [{**vars(bar), "reached": bar.reached} for bar in bars],
        "plates": [vars(plate) for plate in plates],
        "frames": list(rows),
    }
    (out / "agreement.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def write_picture(path: Path, compared: ComparedFrame) -> None:
    """The left eye by both engines, and their difference: middle grey where there is none."""
    one, other = compared.one.plain.left, compared.other.plain.left
    rows, columns = np.nonzero((one.part_id > 0) | (other.part_id > 0))
    window = (slice(None), slice(None))
    if len(rows):
        window = (_span(rows, one.part_id.shape[0]), _span(columns, one.part_id.shape[1]))
    values = [luminance(eye.radiance_cd_m2[window]) for eye in (one, other)]
    white = float(np.percentile(values[0], 99.5)) or 1.0
    shown = [np.clip(value / white, 0.0, 1.0) ** (1 / 2.2) for value in values]
    shown.append(np.clip(0.5 + _DIFFERENCE_SCALE * (values[1] - values[0]) / white / 2, 0.0, 1.0))
    cv2.imwrite(str(path), (np.concatenate(shown, axis=1) * 255).astype(np.uint8))


def _span(indices: NDArray[np.intp], size: int) -> slice:
    return slice(max(int(indices.min()) - _MARGIN_PX, 0), min(int(indices.max()) + _MARGIN_PX + 1, size))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else 0.0
