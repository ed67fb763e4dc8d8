from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.storage.pair_faults import PairFaults
from datasets_manifest.types.estimates import NoFix, PoseEstimate, write_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.pose_benchmark import run_benchmark, score_methods
from droguekit.scoring.poses.centroid_errors import centroid_errors
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.poses.pose_errors import estimates_by_method
from droguekit.scoring.report.pose_report import result_sentences
from droguekit.scoring.results.benchmark_result import BenchmarkResult, DatasetFacts
from geometry.se3 import RigidTransform, exp_twist

DatasetFixture = tuple[Path, list[PairRecord]]

FACTS = DatasetFacts(name="test", sha256="0" * 64, pairs=1)

ROW_KEYS = {
    *("n", "fix_fraction", "bound_ratio", "transverse_rmse_m"),
    *("position_mean_m", "position_rmse_m", "position_p95_m", "position_p99_m"),
    *("x_rmse_m", "y_rmse_m", "z_rmse_m", "x_bias_m", "y_bias_m", "z_bias_m"),
    *("pitch_rmse_deg", "yaw_rmse_deg", "pitch_p99_deg", "yaw_p99_deg"),
}


def shifted(pose: RigidTransform, offset_m: tuple[float, float, float]) -> RigidTransform:
    return RigidTransform(pose.rotation, pose.translation_m + np.array(offset_m))


def score_records(records: list[PairRecord], estimates: list[PoseEstimate | NoFix]) -> BenchmarkResult:
    truths = {record.frame_index: drogue_truth(record) for record in records}
    return score_methods(FACTS, truths, estimates_by_method(estimates, truths, "estimates"))


def test_the_json_has_the_fixed_keys(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    write_estimates(tmp_path / "e.jsonl", build.estimates(records, {"joint": 1.0, "paper": 3.0}, rng))
    result = run_benchmark(folder, tmp_path / "e.jsonl")
    table = json.loads(result.to_json())
    assert table == json.loads(result.model_dump_json())
    assert table["schema"] == 1
    assert table["dataset"] == {"name": "bench-test", "sha256": result.dataset.sha256, "pairs": 10}
    assert set(table["methods"]) == {"joint", "paper"}
    for method in table["methods"].values():
        assert len(method["bins"]) == 3
        for row in (method["overall"], *method["bins"]):
            assert set(row) >= ROW_KEYS
            assert set(row["bound_ratio"]) == {"x", "y", "z", "pitch", "yaw"}
        assert all({"low_m", "high_m"} <= set(row) for row in method["bins"])
    assert BenchmarkResult.model_validate(table) == result


def test_the_json_compares_with_the_best_method_and_with_the_papers(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    write_estimates(tmp_path / "e.jsonl", build.estimates(records, {"joint": 1.0, "paper": 8.0, "mean": 3.0}, rng))
    table = json.loads(run_benchmark(folder, tmp_path / "e.jsonl").to_json())
    pairs = {(row["method"], row["against"]): row for row in table["comparisons"]}
    assert list(pairs) == [("paper", "joint"), ("mean", "joint"), ("joint", "paper"), ("mean", "paper")]
    ratios = [pairs[pair]["overall"]["position"] for pair in (("paper", "joint"), ("joint", "paper"))]
    # The same frames both ways: rounding.
    assert ratios[0] * ratios[1] == pytest.approx(1, rel=1e-12)
    assert all(len(row["bins"]) == 3 for row in table["comparisons"])


def test_normalized_errors_and_nees_are_one_for_least_squares(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """Poses that least squares makes of markers alone reach their own bound, not that of markers and hub."""
    records, sigma = build.records([2.0, 9.0], 200, rng), 0.02
    estimates = []
    for record in records:
        truth = drogue_truth(record)
        features = tuple(
            f.model_copy(update={"used": f.index != "hub"})
            for f in build.features(record, lambda: rng.normal(0, sigma, 2))
        )
        rows = truth.jacobian[:, :8, :, :6].reshape(-1, 6)
        offsets = centroid_errors(truth, features).offset_px.reshape(2, 9, 2)[:, :8]
        twist = np.linalg.lstsq(rows, offsets.ravel(), rcond=None)[0]
        rotation = exp_twist(np.r_[0, 0, 0, twist[3:]]).rotation @ truth.left_from_drogue.rotation
        pose = RigidTransform(rotation, truth.left_from_drogue.translation_m + twist[:3])
        estimate = build.estimate(record.frame_index, pose, "markers", features)
        covariance = sigma**2 * np.linalg.inv(rows.T @ rows)
        estimates.append(estimate.model_copy(update={"covariance": covariance}))
    method = score_records(records, estimates).methods["markers"]
    for row in (method.overall, *method.bins):
        # Relative standard error of a root mean square 1 / sqrt(2 n); four of those.
        tolerance = 4 / np.sqrt(2 * row.n)
        own = row.normalized_own.nrms
        assert [own.x, own.y, own.z, own.pitch, own.yaw] == pytest.approx([1] * 5, abs=tolerance)
        # Standard error of the mean of chi-square over its freedom; four of those.
        assert row.nees.position.per_freedom == pytest.approx(1, abs=4 * np.sqrt(2 / (3 * row.n)))
        assert row.nees.attitude.per_freedom == pytest.approx(1, abs=4 * np.sqrt(2 / (2 * row.n)))
        assert (row.nees.n, row.nees.unusable, row.flips.flips) == (row.n, 0, 0)
    # The hub knows the tilt of a far drogue better than the ring does.
    assert method.bins[1].normalized.nrms.pitch > 1.5


def test_the_hub_counts_at_its_own_noise(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([5.0], 20, rng)
    estimates = []
    for record in records:
        noisy = build.features(record, lambda: rng.normal(0, 0.05, 2))
        coarse = build.features(record, lambda: rng.normal(0, 0.2, 2))
        mixed = tuple(c if c.index == "hub" else f for f, c in zip(noisy, coarse, strict=True))
        estimates.append(build.estimate(record.frame_index, record.left_from_drogue, "joint-hub", mixed))
    place = score_records(records, estimates).reference[0]
    assert (place.centroid_method, place.hub_method) == ("joint-hub", "joint-hub")
    # 640 and 80 coordinates know their noise to 3 and 8 %; three of those.
    assert place.centroid_sigma_px == pytest.approx(0.05, rel=0.09)
    assert place.hub_sigma_px == pytest.approx(0.2, rel=0.24)


def test_a_failure_counts_with_the_spread_of_the_truth(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([3.0, 12.0], 5, rng)
    poses = [build.estimate(r.frame_index, r.left_from_drogue) for r in records[:8]]
    row = score_records(records, poses).methods["joint"].overall
    assert (row.failures, row.z_rmse_m) == (2, 0)
    # Half of the pairs at 3 m and half at 12 m: standard deviation 4.5 m, in 2 of 10.
    assert row.rmse_with_failures.z_m == pytest.approx(4.5 * np.sqrt(0.2), rel=1e-9)


def test_a_known_shift_is_told_as_it_is(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([4.0], 6, rng)
    offset = (0.003, -0.004, 0.012)
    estimates = [build.estimate(r.frame_index, shifted(r.left_from_drogue, offset)) for r in records]
    row = score_records(records, estimates).methods["joint"].overall
    # Rounding.
    assert row.position_mean_m == pytest.approx(0.013, rel=1e-9)
    assert row.position_p99_m == pytest.approx(0.013, rel=1e-9)
    assert (row.x_bias_m, row.y_bias_m, row.z_bias_m) == pytest.approx(offset, rel=1e-9)
    assert (row.x_rmse_m, row.y_rmse_m, row.z_rmse_m) == pytest.approx((0.003, 0.004, 0.012), rel=1e-9)
    assert row.pitch_rmse_deg == 0
    # Without features there is no noise, and so no bound.
    assert row.bound_ratio is None
    assert row.centroid_share is None


def test_the_ratio_is_one_for_errors_of_the_bound(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """Poses that are off by exactly the bound of their frame have ratio 1 in every bin and overall."""
    records, sigma = build.records([2.0, 9.0], 30, rng), 0.07
    features = {r.frame_index: build.features(r, lambda: rng.choice([-sigma, sigma], 2)) for r in records}
    plain = score_records(
        records, [build.estimate(r.frame_index, r.left_from_drogue, "a", features[r.frame_index]) for r in records]
    )
    # Every coordinate is off by sigma, so the measured noise is sigma up to rounding.
    assert [b.centroid_sigma_px for b in plain.reference] == pytest.approx([sigma, sigma], rel=1e-9)
    for k, bin_ in enumerate(plain.reference):
        frames = records[30 * k : 30 * k + 30]
        offset = (bin_.bound.x_m, bin_.bound.y_m, -bin_.bound.z_m)
        moved = [
            build.estimate(r.frame_index, shifted(r.left_from_drogue, offset), "a", features[r.frame_index])
            for r in frames
        ]
        ratio = score_records(frames, moved).methods["a"].overall.bound_ratio
        assert (ratio.x, ratio.y, ratio.z) == pytest.approx((1, 1, 1), rel=1e-9)
        assert ratio.pitch == 0


def test_the_bound_is_the_same_for_every_method(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([5.0], 10, rng)
    noise = {"fine": 0.05, "coarse": 0.3}
    estimates = [
        build.estimate(r.frame_index, r.left_from_drogue, name, build.features(r, lambda s=s: rng.normal(0, s, 2)))
        for r in records
        for name, s in noise.items()
    ]
    result = score_records(records, estimates)
    assert result.reference[0].centroid_method == "fine"
    assert result.methods["fine"].overall.bound == result.methods["coarse"].overall.bound
    # 320 coordinates know their noise to 4 %; three of those.
    assert result.methods["coarse"].overall.centroids.sigma_px == pytest.approx(0.3, rel=0.12)


def test_a_method_that_measured_little_sets_no_standard(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([5.0], 10, rng)
    estimates = [
        build.estimate(r.frame_index, r.left_from_drogue, "all", build.features(r, lambda: rng.normal(0, 0.2, 2)))
        for r in records
    ]
    lucky = build.features(records[0], lambda: (0.001, 0.001))
    estimates.append(build.estimate(records[0].frame_index, records[0].left_from_drogue, "lucky", lucky))
    assert score_records(records, estimates).reference[0].centroid_method == "all"


def test_centroids_explain_what_they_cause(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """A pose shifted together with its centroids is all theirs; the same shift with true centroids is the method's."""
    records = build.records([6.0], 8, rng)
    theirs, own = [], []
    for record in records:
        pose = shifted(record.left_from_drogue, tuple(rng.normal(0, 1e-4, 3)))
        with_pose = build.features(build.record(record.frame_index, pose), lambda: (0.0, 0.0))
        theirs.append(build.estimate(record.frame_index, pose, "theirs", with_pose))
        own.append(build.estimate(record.frame_index, pose, "own", build.features(record, lambda: (0.0, 0.0))))
    methods = score_records(records, [*theirs, *own]).methods
    # First order in a shift of 1e-4 of 6 m.
    assert methods["theirs"].overall.centroid_share == pytest.approx(1, abs=1e-3)
    assert methods["own"].overall.centroid_share == pytest.approx(0, abs=1e-9)


def test_missing_and_refused_frames_count_as_not_fixed(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([3.0, 12.0], 4, rng)
    estimates = [build.estimate(r.frame_index, r.left_from_drogue) for r in records[:3]]
    estimates.append(NoFix(frame_index=records[3].frame_index, method="joint", reason="dark"))
    method = score_records(records, estimates).methods["joint"]
    assert (method.overall.n, method.overall.fixes, method.overall.fix_fraction) == (8, 3, 3 / 8)
    assert [row.fix_fraction for row in method.bins] == [0.75, 0.0]
    assert method.bins[1].position_mean_m is None
    assert method.bins[1].bound_ratio is None
    low, high = method.overall.intervals["fix_fraction"]
    assert low < 3 / 8 < high


def test_a_single_pose_has_no_interval_of_its_mean(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([3.0], 4, rng)
    moved = shifted(records[0].left_from_drogue, (0.0, 0.0, 1e-3))
    result = score_records(records, [build.estimate(records[0].frame_index, moved)])
    row = result.methods["joint"].overall
    assert row.position_mean_m == pytest.approx(1e-3)
    assert not any(key.split("_")[1] in ("mean", "bias", "p95", "p99") for key in row.intervals)
    # The chi-square law with one degree of freedom: 2.5 % of squares are below 0.000982, 97.5 % below 5.0239.
    assert row.intervals["z_rmse_m"] == pytest.approx((1e-3 / 5.0239**0.5, 1e-3 / 0.000982069**0.5), rel=1e-4)
    told = " ".join(result_sentences(result))
    assert "its mean position error is 1.00 mm, and it found a pose in 25 % of the pairs" in told


def test_pairs_of_a_sequence_count_once(build: SimpleNamespace, rng: np.random.Generator) -> None:
    """Each flight has an offset of its own: a hundred pairs of three flights know the mean no better than three."""
    records = [r for s in range(3) for r in build.sequence(build.swinging, 30, sequence_id=s)]
    offsets_m = [1e-3, 2e-3, 3e-3]
    estimates = [
        build.estimate(r.frame_index, shifted(r.left_from_drogue, (offsets_m[r.sequence_id], 0.0, 0.0)))
        for r in records
    ]
    row = score_records(records, estimates).methods["joint"].overall
    # 97.5 % of Student's law with two degrees of freedom lie below 4.30265; the offsets' deviation is 1 mm.
    half_m = 4.30265e-3 / 3**0.5
    assert row.intervals["x_bias_m"] == pytest.approx((2e-3 - half_m, 2e-3 + half_m), rel=1e-4)
    assert row.intervals["position_mean_m"] == pytest.approx((0.0, 2e-3 + half_m), rel=1e-4)
    # Three degrees of freedom at most.
    low, high = row.intervals["x_rmse_m"]
    assert high / low > 4


def test_a_pose_where_there_is_no_drogue_is_a_false_one(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([3.0], 2, rng, empty=3)
    estimates = [build.estimate(r.frame_index, build.pose(0, 0, 3)) for r in records[:4]]
    method = score_records(records, estimates).methods["joint"]
    assert method.overall.n == 2
    assert (method.empty_frames.n, method.empty_frames.false_fixes) == (3, 2)


def test_the_order_of_the_file_does_not_matter(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    estimates = build.estimates(records, {"joint": 1.0}, rng)
    texts = []
    for order in (estimates, [estimates[k] for k in rng.permutation(len(estimates))]):
        write_estimates(tmp_path / "e.jsonl", order)
        texts.append(run_benchmark(folder, tmp_path / "e.jsonl").to_json())
    assert texts[0] == texts[1]


def test_symmetric_poses_score_alike(build: SimpleNamespace, rng: np.random.Generator) -> None:
    records = build.records([3.0], 5, rng)
    turn = build.pose(0, 0, 0, roll_deg=45)
    results = [
        score_records(records, [build.estimate(r.frame_index, r.left_from_drogue @ t) for r in records])
        for t in (build.pose(0, 0, 0), turn)
    ]
    # Rounding of products of rotations, in degrees.
    assert results[1].methods["joint"].overall.pitch_rmse_deg == pytest.approx(0, abs=1e-12)
    assert results[0].methods["joint"].overall.position_mean_m == results[1].methods["joint"].overall.position_mean_m


def test_an_empty_file_is_named(dataset: DatasetFixture, tmp_path: Path) -> None:
    (tmp_path / "e.jsonl").write_text("")
    with pytest.raises(ValueError, match=r"e\.jsonl: holds no estimates"):
        run_benchmark(dataset[0], tmp_path / "e.jsonl")


def test_a_foreign_frame_is_named(build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path) -> None:
    write_estimates(tmp_path / "e.jsonl", [build.estimate(77, build.pose(0, 0, 3))])
    with pytest.raises(ValueError, match=r"e\.jsonl: method 'joint': frame 77 is not in the dataset"):
        run_benchmark(dataset[0], tmp_path / "e.jsonl")


def test_a_feature_that_the_drogue_lacks_is_named(build: SimpleNamespace) -> None:
    record = build.record(4, build.pose(0.1, 0, 5))
    feature = build.features(record, lambda: (0.0, 0.0))[0].model_copy(update={"index": 11})
    with pytest.raises(ValueError, match="method 'joint': frame 4: features: index must be"):
        score_records([record], [build.estimate(4, record.left_from_drogue, "joint", (feature,))])


def test_a_dataset_without_any_drogue_is_refused(build: SimpleNamespace) -> None:
    with pytest.raises(ValueError, match="no pair shows a drogue"):
        score_records([build.record(0, None)], [build.estimate(0, build.pose(0, 0, 3))])


@pytest.mark.parametrize("damaged", [(0,), (0, 1)])
def test_damaged_pairs_are_named_where_no_other_shows_a_drogue(
    build: SimpleNamespace, tmp_path: Path, damaged: tuple[int, ...]
) -> None:
    folder = build.dataset(tmp_path / "dataset", [build.record(0, build.pose(0.1, 0, 5)), build.record(1, None)])
    for frame in damaged:
        (folder / "frames" / f"{frame:06d}" / "record.json").write_text("{")
    write_estimates(tmp_path / "e.jsonl", [build.estimate(0, build.pose(0, 0, 3))])
    wanted = r"dataset: no pair that can be read shows a drogue, .*: {} no result .* pair 0: .*000000.record\.json"
    with pytest.raises(ValueError, match=wanted.format("1 pair has" if len(damaged) == 1 else "2 pairs have")):
        run_benchmark(folder, tmp_path / "e.jsonl", PairFaults())


def test_it_runs_where_no_renderer_is_installed(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    write_estimates(tmp_path / "e.jsonl", build.estimates(records, {"joint": 1.0}, rng))
    program = """
import sys
from pathlib import Path
BLOCKED = ("mitsuba", "bpy", "torch", "trimesh", "scenes", "render", "labelgen", "droguekit.batch")


class Wall:
    def find_spec(self, name, path=None, target=None):
        if name in BLOCKED:
            raise ImportError(f"{name} is not for the benchmark")


sys.meta_path.insert(0, Wall())
from droguekit.scoring.pose_benchmark import run_benchmark
from droguekit.scoring.report.pose_report import write_report
folder, estimates, page = map(Path, sys.argv[1:])
write_report(folder, estimates, run_benchmark(folder, estimates), page)
"""
    arguments = [str(folder), str(tmp_path / "e.jsonl"), str(tmp_path / "report.html")]
    done = subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "report.html").is_file()
