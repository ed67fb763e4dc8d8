"""Depths against a rangefinder's readings."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.recipe.recipe import load_recipe
from datasets_manifest.types.estimates import write_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.pose_benchmark import run_benchmark, score_methods
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.poses.pose_errors import estimates_by_method
from droguekit.scoring.report.pose_report import write_report
from droguekit.scoring.results.benchmark_result import BenchmarkResult, DatasetFacts
from geometry.se3 import RigidTransform
from scenes.sampler import sample_rangefinder_m


def read(record: PairRecord, reading_m: float) -> PairRecord:
    frame = record.frame.model_copy(update={"rangefinder_reading_m": reading_m})
    return record.model_copy(update={"frame": frame})


def scored(records: list[PairRecord], estimates: list[object]) -> BenchmarkResult:
    truths = {record.frame_index: drogue_truth(record) for record in records}
    facts = DatasetFacts(name="test", sha256="0" * 64, pairs=len(records))
    return score_methods(facts, truths, estimates_by_method(estimates, truths, "estimates"))


def deeper(build: SimpleNamespace, record: PairRecord, by_m: float) -> object:
    pose = record.left_from_drogue
    moved = RigidTransform(pose.rotation, pose.translation_m + np.array([0.0, 0.0, by_m]))
    return build.estimate(record.frame_index, moved, "shifted", ())


def test_offsets_of_method_and_rangefinder_are_told_apart(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = [
        read(record, record.left_from_drogue.translation_m[2] + 0.003) for record in build.records([2.0, 8.0], 5, rng)
    ]
    method = scored(records, [deeper(build, record, 0.005) for record in records]).methods["shifted"]
    found = method.overall.rangefinder
    # Lengths of some metres in float64.
    assert found.n == 10
    assert (found.against_truth.bias_m, found.against_truth.rmse_m) == pytest.approx((0.005, 0.005), abs=1e-12)
    assert (found.reading.bias_m, found.reading.mean_absolute_m) == pytest.approx((0.003, 0.003), abs=1e-12)
    assert (found.against_reading.bias_m, found.against_reading.rmse_m) == pytest.approx((0.002, 0.002), abs=1e-12)
    for row, distance_m in zip(method.bins, (2.0, 8.0), strict=True):
        assert row.rangefinder.n == 5
        assert row.rangefinder.against_truth.mean_absolute_fraction == pytest.approx(0.005 / distance_m, rel=1e-6)
        assert row.rangefinder.against_reading.mean_absolute_fraction == pytest.approx(
            0.002 / (distance_m + 0.003), rel=1e-6
        )


def test_a_perfect_method_has_the_errors_of_the_shipped_rangefinder(
    build: SimpleNamespace, rng: np.random.Generator
) -> None:
    """What the paper's bench would say of a method that does not err."""
    rangefinder = load_recipe("semi-physical-7").recipe.rangefinder
    records = [
        read(record, sample_rangefinder_m(rangefinder, 3, record.frame_index, record.left_from_drogue.translation_m[2]))
        for record in build.records([5.0], 100, rng)
    ]
    found = scored(records, [deeper(build, record, 0.0) for record in records]).methods["shifted"].overall.rangefinder
    assert found.against_truth.rmse_m == 0
    assert found.against_reading.rmse_m == pytest.approx(found.reading.rmse_m, rel=1e-12)
    scatter_m = np.sqrt(found.reading.rmse_m**2 - found.reading.bias_m**2)
    # Noise, and the rounding's step / sqrt(12); 100 readings know their scatter to 7 %, three of those.
    expected_m = np.hypot(rangefinder.noise_m, rangefinder.resolution_m / np.sqrt(12))
    assert scatter_m == pytest.approx(expected_m, rel=0.21)
    assert abs(found.reading.bias_m) < rangefinder.offset_m + 3 * expected_m / np.sqrt(100)


def test_pairs_without_a_reading_or_a_pose_do_not_count(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([4.0], 6, rng)
    assert scored(records, [deeper(build, records[0], 0.0)]).methods["shifted"].overall.rangefinder is None
    known = [read(record, 4.0) for record in records[:4]] + records[4:]
    method = scored(known, [deeper(build, record, 0.0) for record in known[2:]]).methods["shifted"]
    assert method.overall.rangefinder.n == 2


@pytest.mark.parametrize("has_readings", [False, True])
def test_the_report_has_the_table_where_there_are_readings(
    build: SimpleNamespace, rng: np.random.Generator, tmp_path: Path, has_readings: bool
) -> None:
    records = build.records([3.0], 3, rng)
    if has_readings:
        records = [read(record, 3.002) for record in records]
    folder = build.dataset(tmp_path / "data", records)
    write_estimates(tmp_path / "e.jsonl", [deeper(build, record, 0.0071) for record in records])
    result = run_benchmark(folder, tmp_path / "e.jsonl")
    assert BenchmarkResult.model_validate_json(result.to_json()) == result
    write_report(folder, tmp_path / "e.jsonl", result, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert ('id="table-rangefinder"' in page) == has_readings
    assert ("An experiment that takes a rangefinder" in page) == has_readings
    if has_readings:
        table = page[page.index('id="table-rangefinder"') :]
        assert "<td>7.10</td>" in table[: table.index("</table>")]
