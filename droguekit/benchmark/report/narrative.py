"""The result in plain sentences, written from the numbers."""

from __future__ import annotations

from droguekit.benchmark.poses.ranking import best_method
from droguekit.benchmark.report.number_text import (
    distance_text,
    interval_text,
    millimetres,
    percent,
    plain_number,
    three_digits,
)
from droguekit.benchmark.results.benchmark_result import BenchmarkResult, BinRow


def result_sentences(result: BenchmarkResult) -> list[str]:
    """What came out, one thought a sentence."""
    low, high = (plain_number(end) for end in (result.reference[0].low_m, result.reference[-1].high_m))
    shown = sum(place.n for place in result.reference)
    best = best_method(result.methods)
    if best is None:
        return [f"None of the methods found a pose in any of the {shown} pairs, from {low} to {high} m."]
    method = result.methods[best]
    ends = interval_text(method.overall.intervals["position_mean_m"], 1e3)
    sentences = [
        f"Over {shown} stereo pairs from {low} to {high} m, {best} came closest to the truth: its mean position error "
        f"is {millimetres(method.overall.position_mean_m)} mm (95 % interval {ends} mm), and it found a pose in "
        f"{percent(method.overall.fix_fraction)} of the pairs."
    ]
    fixed = [row for row in method.bins if row.fixes]
    sentences += [_at(row) for row in (fixed[0], fixed[-1])[: len(fixed)]]
    sentences += _against_bound(result, best)
    empty = method.empty_frames
    if empty.n:
        sentences.append(f"It reported a pose in {empty.false_fixes} of {empty.n} pairs without a drogue.")
    return sentences + _others(result, best)


def _at(row: BinRow) -> str:
    return (
        f"At {distance_text(row.low_m, row.high_m)} its RMS error is {millimetres(row.z_rmse_m)} mm in depth, "
        f"{millimetres(row.transverse_rmse_m)} mm across the line of sight, {three_digits(row.pitch_rmse_deg)} deg in "
        f"pitch and {three_digits(row.yaw_rmse_deg)} deg in yaw."
    )


def _against_bound(result: BenchmarkResult, name: str) -> list[str]:
    overall = result.methods[name].overall
    sentences = []
    ratios = [row.bound_ratio.z for row in result.methods[name].bins if row.bound_ratio is not None]
    if ratios:
        sentences.append(
            f"Bin by bin, its depth error is {_span(ratios)} times the Cramér–Rao bound, the smallest error that "
            "centroids of the measured noise allow."
        )
    if overall.centroid_share is not None:
        sentences.append(
            f"The errors of its own centroids explain {percent(round(overall.centroid_share, 3))} of its mean squared "
            "position error; the rest is the method's own."
        )
    return sentences


def _others(result: BenchmarkResult, best: str) -> list[str]:
    others = {
        name: method.overall.position_mean_m
        for name, method in result.methods.items()
        if name != best and method.overall.position_mean_m is not None
    }
    silent = [name for name, method in result.methods.items() if not method.overall.fixes]
    sentences = []
    if others:
        ranked = sorted(others, key=lambda name: others[name])
        listed = ", ".join(
            f"{name} {millimetres(others[name])} mm ({percent(result.methods[name].overall.fix_fraction)} of pairs)"
            for name in ranked
        )
        sentences.append(f"Mean position errors of the other methods: {listed}.")
    if silent:
        sentences.append(f"No pose at all came from {', '.join(silent)}.")
    return sentences


def _span(values: list[float]) -> str:
    low, high = three_digits(min(values)), three_digits(max(values))
    return low if low == high else f"{low} to {high}"
