"""Sequences in `benchmark.json` and in both reports, from a dataset on disk."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from datasets_manifest.types.estimates import Docking, Estimate, Motion, NoFix, PoseEstimate, Region, write_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.detection.detection_report import write_detection_report
from droguekit.scoring.detection.detection_scores import DetectorOutput, score_detections
from droguekit.scoring.detection.detection_truth import read_detection_truth
from droguekit.scoring.pose_benchmark import run_benchmark, score_sequences
from droguekit.scoring.poses.drogue_truth import drogue_truth
from droguekit.scoring.report.figures import DistanceLine, Point, distance_lines_panel, legend_key, method_styles
from droguekit.scoring.report.pose_report import write_report
from droguekit.scoring.report.sequence_report import sequence_section, sequence_sentences
from droguekit.scoring.results.benchmark_result import BenchmarkResult
from droguekit.scoring.results.detection_result import DetectedBox, corner_box, image_id_of
from droguekit.scoring.results.sequence_result import SequencesResult
from droguekit.scoring.sequences.sequence_truth import true_sequences, true_state
from geometry.se3 import RigidTransform
from geometry.stereo import EYES
from tests.support.parsed_page import ParsedPage

COUNT = 50
HIDDEN = (20, 21, 22)
METHODS = ("joint", "joint+filter")


def estimates_of(records: list[PairRecord], rng: np.random.Generator) -> list[Estimate]:
    """Every part that sequences have; a pose in one hidden pair, and one pair that was late."""
    estimates: list[Estimate] = []
    for k, record in enumerate(records):
        view, pose = record.views, record.left_from_drogue
        regions = tuple(
            Region(eye=eye, box_xywh_px=one.box_visible_xywh_px, source="flow", score=0.9)
            for eye, one in zip(EYES, (view.left, view.right), strict=True)
            if one.box_visible_xywh_px is not None
        )
        for method in METHODS:
            head = {"frame_index": record.frame_index, "method": method}
            common = {
                **head,
                "regions": regions,
                "stage_s": {"detect": 0.004, "pose": 0.002},
                "latency_s": 0.01 + 1e-4 * k,
            }
            if k in HIDDEN and k != HIDDEN[0]:
                estimates.append(NoFix(**common, reason="nothing seen"))
            elif k == 10:
                estimates.append(NoFix(**common, reason="late: newer ones had come"))
            else:
                moved = RigidTransform(pose.rotation, pose.translation_m + rng.normal(0, 0.002, 3))
                more = {}
                if method == METHODS[1]:
                    more["motion"] = Motion(
                        velocity_m_s=(0.0, 0.0, -0.5), rate_rad_s=(0.0, 0.0, 0.0), covariance=0.1 * np.eye(6)
                    )
                    more["docking"] = Docking(
                        mouth_from_tip_m=(float(pose.translation_m[2]) - 1, 0.0, 0.0),
                        mouth_sd_m=(0.1, 0.1, 0.1),
                        closure_m_s=0.5,
                        miss_m=0.2,
                        miss_sd_m=0.1,
                        contact_s=9.0,
                        captured=False,
                    )
                estimates.append(PoseEstimate(**common, left_from_drogue=moved, covariance=4e-6 * np.eye(6), **more))
    return estimates


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A folder, and the records in it once they are made."""
    return SimpleNamespace(folder=tmp_path_factory.mktemp("flight"), records=[])


@pytest.fixture
def flown(build: SimpleNamespace, flight: SimpleNamespace) -> tuple[Path, list[PairRecord]]:
    """Two sequences of 50 pairs on disk, made once; three pairs of the first show nothing."""
    if not flight.records:
        flight.records += build.sequence(build.swinging, COUNT, hidden=HIDDEN)
        flight.records += build.sequence(build.swinging, COUNT, sequence_id=1)
        build.dataset(flight.folder, flight.records, alike=True)
    return flight.folder, flight.records


@pytest.fixture
def scored(
    flown: tuple[Path, list[PairRecord]], tmp_path: Path, rng: np.random.Generator
) -> tuple[Path, Path, BenchmarkResult]:
    estimates = tmp_path / "estimates.jsonl"
    write_estimates(estimates, estimates_of(flown[1], rng))
    return flown[0], estimates, run_benchmark(flown[0], estimates)


def ids_without_keys(text: str) -> list[str]:
    """Ids of a page; keys of the legends are alike, and so are their ids."""
    return [each for each in ParsedPage(text).ids if not each.startswith("key-")]


def test_the_numbers_are_those_that_went_in(scored: tuple[Path, Path, BenchmarkResult]) -> None:
    result = scored[2].sequences
    assert result is not None
    assert (result.count, result.pairs, set(result.methods)) == (2, 100, set(METHODS))
    assert result.minutes == pytest.approx(2 * 49 / 25 / 60)
    raw, filtered = (result.methods[name] for name in METHODS)
    assert (raw.hiding.hidden, raw.hiding.poses_while_hidden) == (3, 1)
    assert (raw.hiding.reacquisition.n, raw.hiding.reacquisition.max_frames) == (1, 0)
    assert raw.tracking is not None and raw.tracking.both.overlap is not None
    assert raw.tracking.both.overlap.auc == pytest.approx(20 / 21)
    assert (raw.filtering, raw.docking) == (None, None)
    assert filtered.filtering is not None and filtered.docking is not None
    assert filtered.filtering.raw is not None and filtered.filtering.raw.against == "joint"
    assert filtered.docking.overall.n == 97
    latency = raw.latency
    assert latency is not None and latency.overall is not None
    # Percentiles by numpy, of 10 ms and 0.1 more for each pair, without the late one.
    times = 10 + 0.1 * np.delete(np.arange(100), 10)
    expected = np.percentile(times, (50, 95, 99))
    assert (latency.overall.p50_ms, latency.overall.p95_ms, latency.overall.p99_ms) == pytest.approx(expected)
    assert latency.stages["detect"].p50_ms == pytest.approx(4)
    assert (latency.late, latency.answers, latency.late_fraction) == (1, 100, 0.01)
    assert (latency.overall.n, sum(row.n for row in latency.bins)) == (99, 99)
    # The drogue's motion is known away from the ends of both sequences: of 84 pairs, 3 have no pose.
    motion = filtered.filtering.motion
    assert motion is not None and (motion.n, motion.of, filtered.docking.overall.of) == (81, 84, 100)


def score_of(records: list[PairRecord], methods: dict[str, dict[int, Estimate]]) -> SequencesResult:
    result = score_sequences(
        true_sequences([true_state(record) for record in records]),
        {record.frame_index: drogue_truth(record) for record in records},
        methods,
    )
    assert result is not None
    return result


def test_where_all_are_late_that_is_what_is_told(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 12)
    late = {k: NoFix(frame_index=k, method="m", reason="late: newer ones had come") for k in range(12)}
    result = score_of(records, {"m": late})
    latency = result.methods["m"].latency
    assert latency is not None
    assert (latency.overall, latency.bins, latency.stages) == (None, (), {})
    assert (latency.answers, latency.late, latency.late_fraction) == (12, 12, 1)
    assert "m: 100 % of the pairs late." in sequence_sentences(result)
    section = sequence_section(result, method_styles(["m"]))
    tables = {table.anchor: table for part in section.parts for table in part.tables}
    assert tables["latency"].groups[0].rows == [["m", "0", "–", "–", "–", "–"]]
    assert tables["late"].groups[0].rows == [["m", "12", "12", "100 %"]]


def test_a_pose_beside_the_drogue_has_not_found_it(build: SimpleNamespace) -> None:
    """Back in pair 4, with poses a rim's radius and more beside it until pair 6; while it is hidden any pose counts."""
    records = build.sequence(build.swinging, 8, hidden=(2, 3))
    radius_m = records[0].frame.drogue.rim_radius_m
    poses = {}
    for k, record in enumerate(records):
        aside_m = {2: 5.0, 3: 5.0, 4: 1.01 * radius_m, 5: 30.0, 6: 0.99 * radius_m}.get(k, 0.0)
        pose = record.left_from_drogue
        moved = RigidTransform(pose.rotation, pose.translation_m + np.array([aside_m, 0.0, 0.0]))
        poses[k] = PoseEstimate(frame_index=k, method="m", left_from_drogue=moved, latency_s=0.01)
    hiding = score_of(records, {"m": poses}).methods["m"].hiding
    assert (hiding.hidden, hiding.poses_while_hidden) == (2, 2)
    assert (hiding.reacquisition.n, hiding.reacquisition.max_frames) == (1, 2)


def test_methods_with_poses_while_hidden_are_named(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 6, hidden=(2, 3))
    methods: dict[str, dict[int, Estimate]] = {name: {} for name in ("good", "bad")}
    for name, answers in methods.items():
        for k, record in enumerate(records):
            pose = record.left_from_drogue
            if name == "bad" or k not in (2, 3):
                answers[k] = PoseEstimate(frame_index=k, method=name, left_from_drogue=pose, latency_s=0.01)
    assert sequence_sentences(score_of(records, methods))[-1] == "Poses while the drogue was hidden: bad 2."
    told = sequence_sentences(score_of(records, {"good": methods["good"]}))
    assert told[-1] == "Poses while the drogue was hidden: none."


def test_a_method_has_one_colour_on_the_page(scored: tuple[Path, Path, BenchmarkResult]) -> None:
    """Also where methods before it share an entry of the boxes."""
    result = scored[2].sequences
    assert result is not None
    raw = result.methods["joint"]
    assert raw.tracking is not None
    other = raw.tracking.model_copy(update={"sources": {}})
    methods = {"a": raw, "b": raw, "c": raw.model_copy(update={"tracking": other})}
    styles = method_styles(list(methods))
    section = sequence_section(result.model_copy(update={"methods": methods}), styles)
    (part,) = [one for one in section.parts if one.anchor == "tracking"]
    assert part.legend == [("a, b", legend_key(styles["a"])), ("c", legend_key(styles["c"]))]
    assert all(styles["a"].color in panel and styles["c"].color in panel for panel in part.panels)
    assert not any(styles["b"].color in panel for panel in part.panels)


def test_a_pose_is_out_of_place_only_where_neither_eye_sees_the_drogue(build: SimpleNamespace) -> None:
    records = build.sequence(build.swinging, 8, hidden=(3, 4))
    # One eye still sees it in pair 4.
    seen = build.record(4, records[4].left_from_drogue).views.right
    records[4] = records[4].model_copy(update={"views": records[4].views.model_copy(update={"right": seen})})
    poses = {
        k: PoseEstimate(frame_index=k, method="m", left_from_drogue=record.left_from_drogue, latency_s=0.01)
        for k, record in enumerate(records)
        if k != 5
    }
    hiding = score_of(records, {"m": poses}).methods["m"].hiding
    assert (hiding.hidden, hiding.poses_while_hidden) == (1, 1)
    # Both eyes see it again in pair 5, and the pose comes in pair 6.
    assert (hiding.reacquisition.n, hiding.reacquisition.max_frames) == (1, 1)


def test_they_stand_in_the_file_beside_what_was_there(scored: tuple[Path, Path, BenchmarkResult]) -> None:
    table = json.loads(scored[2].to_json())
    assert {"schema", "dataset", "methods", "comparisons", "sequences"} <= set(table)
    assert table["sequences"]["methods"]["joint"]["docking"] is None
    assert BenchmarkResult.model_validate(table) == scored[2]


def test_nothing_is_told_of_plain_estimates_nor_of_single_pairs(
    flown: tuple[Path, list[PairRecord]],
    dataset: tuple[Path, list[PairRecord]],
    tmp_path: Path,
    rng: np.random.Generator,
) -> None:
    plain = [
        PoseEstimate(frame_index=r.frame_index, method="joint", left_from_drogue=r.left_from_drogue) for r in flown[1]
    ]
    singles = estimates_of([r for r in dataset[1] if r.left_from_drogue is not None], rng)
    for folder, estimates in ((flown[0], plain), (dataset[0], singles)):
        file, page = tmp_path / "estimates.jsonl", tmp_path / "report.html"
        write_estimates(file, estimates)
        result = run_benchmark(folder, file)
        assert "sequences" not in json.loads(result.to_json())
    write_report(folder, file, result, page)
    assert "sequences" not in ParsedPage(page.read_text(encoding="utf-8")).ids


def test_the_page_shows_every_part(scored: tuple[Path, Path, BenchmarkResult], tmp_path: Path) -> None:
    folder, estimates, result = scored
    write_report(folder, estimates, result, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    ids = ids_without_keys(text)
    assert len(ids) == len(set(ids))
    parts = {"sequences", "tracking", "hiding", "filter", "docking", "real-time"}
    tables = {"overlap", "sources", "losses", "hiding", "motion", "motion-nees", "lag", "raw", "mouth", "miss"}
    tables |= {"calibration", "captures", "latency", "late", "stages"}
    assert parts | {f"table-{name}" for name in tables} <= set(ids)
    for name in ("sequence-success", "sequence-precisions", "motion-speed", "docking-mouth", "latency"):
        assert any(one.startswith(f"{name}-") for one in ids)
    assert "Poses while the drogue was hidden: joint 1, joint+filter 1." in text
    # Both methods worked in the same boxes, and share their rows.
    assert "joint, joint+filter" in text
    assert "nan" not in re.sub(r"<svg.*?</svg>|data:[^\"]+", "", text, flags=re.DOTALL).lower()


@pytest.mark.parametrize("part", ["left_from_drogue", "motion", "docking", "latency_s"])
def test_numbers_that_measure_nothing_are_refused_by_name(
    flown: tuple[Path, list[PairRecord]], tmp_path: Path, rng: np.random.Generator, part: str
) -> None:
    """Their squares would overflow."""
    estimates = [json.loads(estimate.model_dump_json()) for estimate in estimates_of(flown[1][:3], rng)]
    last = estimates[-1]
    for path in {"left_from_drogue": (0, 3), "motion": ("velocity_m_s", 1), "docking": ("miss_m",), "latency_s": ()}[
        part
    ]:
        last, part = last[part], path
    last[part] = 1e200
    (tmp_path / "e.jsonl").write_text("\n".join(map(json.dumps, estimates)), encoding="utf-8")
    with pytest.raises(ValueError, match=r"method 'joint\+filter': frame 2: lengths, speeds and times must be at most"):
        run_benchmark(flown[0], tmp_path / "e.jsonl")


def test_panels_with_one_distance_or_none_can_be_drawn() -> None:
    styles = method_styles(["a", "b"])
    one = [DistanceLine("a", [Point(2, 2, 3.0), Point(4, 5, None)]), DistanceLine("b", [Point(2, 2, 0.0)], True)]
    panel = distance_lines_panel("p", "Error [mm]", one, styles)
    ElementTree.fromstring(panel)
    assert styles["a"].color in panel and styles["b"].color not in panel
    assert distance_lines_panel("p", "Error [mm]", [DistanceLine("a", [Point(2, 2, None)])], styles) == ""


def test_files_of_boxes_of_sequences_are_scored_as_trackers(
    flown: tuple[Path, list[PairRecord]], dataset: tuple[Path, list[PairRecord]], tmp_path: Path
) -> None:
    folder, records = flown
    boxes = [
        DetectedBox(image_id_of(record.frame_index, eye), corner_box(view.box_visible_xywh_px), 0.8)
        for record in records
        for eye, view in zip(EYES, (record.views.left, record.views.right), strict=True)
        if view.box_visible_xywh_px is not None and record.frame_index not in (5, 6)
    ]
    truth = read_detection_truth(folder)
    scored = score_detections(truth, {"flow": DetectorOutput(boxes)})
    tracking = scored.result.detectors["flow"].sequences
    assert tracking is not None and tracking.both.losses is not None and tracking.both.overlap is not None
    assert (tracking.both.losses.count, tracking.both.hidden, tracking.both.overlap.n) == (1, 6, 194)
    assert tracking.both.overlap.auc == pytest.approx(190 / 194 * 20 / 21)
    # Of a split only its own sequences: the second one, in which nothing is hidden or lost.
    images = tuple(replace(i, split="test" if i.frame_index >= COUNT else "train") for i in truth.images)
    part = score_detections(replace(truth, images=images), {"flow": DetectorOutput(boxes)}).result.detectors["flow"]
    assert part.sequences is not None and part.sequences.both.overlap is not None
    assert (part.sequences.both.overlap.n, part.sequences.both.hidden) == (2 * COUNT, 0)
    write_detection_report(folder, scored, tmp_path / "report.html")
    ids = ids_without_keys((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert {"tracking", "table-overlap", "table-losses"} <= set(ids)
    assert len(ids) == len(set(ids))

    single = score_detections(read_detection_truth(dataset[0]), {"flow": DetectorOutput(boxes[:2])})
    assert "sequences" not in json.loads(single.result.to_json())["detectors"]["flow"]
    write_detection_report(dataset[0], single, tmp_path / "single.html")
    assert "tracking" not in ParsedPage((tmp_path / "single.html").read_text(encoding="utf-8")).ids
