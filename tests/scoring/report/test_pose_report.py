from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, NoFix, PoseEstimate, write_estimates
from datasets_manifest.types.records import PairRecord
from droguekit.scoring.pose_benchmark import run_benchmark
from droguekit.scoring.poses.method_scores import best_method
from droguekit.scoring.report.figures import QUANTITIES, error_panel, method_styles
from droguekit.scoring.report.label_drawing import contact_tiles, label_picture
from droguekit.scoring.report.number_text import distance_text, percent, plain_number, three_digits
from droguekit.scoring.report.pose_report import result_sentences, stage_times_table, write_report
from droguekit.scoring.results.benchmark_result import BenchmarkResult
from tests.support.parsed_page import ParsedPage

DatasetFixture = tuple[Path, list[PairRecord]]
METHODS = {"joint": 1.0, "paper": 6.0, "circle-fit": 4.0}


@pytest.fixture(scope="module")
def scored(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path, BenchmarkResult]:
    folder, records = dataset
    estimates = tmp_path_factory.mktemp("scored") / "estimates.jsonl"
    write_estimates(estimates, build.estimates(records, METHODS, np.random.default_rng(7)))
    return folder, estimates, run_benchmark(folder, estimates)


@pytest.fixture(scope="module")
def page_text(scored: tuple[Path, Path, BenchmarkResult], tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of `scored`."""
    page = tmp_path_factory.mktemp("page") / "report.html"
    write_report(*scored, page)
    return page.read_text(encoding="utf-8")


def test_the_page_needs_nothing_from_outside(page_text: str) -> None:
    page = ParsedPage(page_text)
    assert page.open_tags == []
    assert all(reference.startswith(("#", "data:image/jpeg;base64,")) for reference in page.references)
    without_pictures = re.sub(r"data:image/jpeg;base64,[\w+/=]+", "", page_text)
    assert not re.search(r"https?:|//[a-z]|@import|url\((?!#)", without_pictures)
    assert "script" not in page.tags
    assert "link" not in page.tags
    targets = {reference[1:] for reference in page.references if reference.startswith("#")}
    assert targets <= set(page.ids)


def test_the_page_has_every_figure_picture_and_table(
    scored: tuple[Path, Path, BenchmarkResult], page_text: str
) -> None:
    text, result = page_text, scored[2]
    for quantity in QUANTITIES:
        assert f'aria-label="{quantity.title} against distance' in text
    assert text.count("data:image/jpeg") == 9
    for name in ("overall", "position", "x", "y", "z", "pitch", "yaw", "centroids", "times"):
        assert f'id="table-{name}"' in text
    for name in ("against-0", "against-1", "normalized", "normalized-own", "flips", "failures"):
        assert f'id="table-{name}"' in text
    # No method of the file reports a covariance.
    assert 'id="table-nees"' not in text
    assert result.dataset.sha256 in text
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text
    assert three_digits(1e3 * result.methods["paper"].overall.position_mean_m) in text


def test_times_of_a_pair_leave_out_waiting(build: SimpleNamespace, tmp_path: Path) -> None:
    stage_s = {"read": 0.512, "wait": 0.256, "handover": 0.128, "track": 0.004, "pose": 0.002}
    told = build.estimate(0, build.pose(0, 0, 5)).model_copy(update={"stage_s": stage_s})
    write_estimates(tmp_path / "e.jsonl", [told])
    table = stage_times_table(tmp_path / "e.jsonl")
    assert table is not None
    ((method, total, stages),) = table.groups[0].rows
    assert (method, total) == ("joint", "6.00")
    assert stages == "read 512, wait 256, handover 128, track 4.00, pose 2.00"


def test_the_page_is_the_same_every_time(
    scored: tuple[Path, Path, BenchmarkResult], page_text: str, tmp_path: Path
) -> None:
    write_report(*scored, tmp_path / "again.html")
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == page_text


def test_a_result_of_another_dataset_is_refused(scored: tuple[Path, Path, BenchmarkResult], tmp_path: Path) -> None:
    folder, estimates, result = scored
    other = result.model_copy(update={"dataset": result.dataset.model_copy(update={"sha256": "f" * 64})})
    with pytest.raises(ValueError, match="is not the dataset of this result"):
        write_report(folder, estimates, other, tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


def test_names_from_files_cannot_break_the_page(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    estimates = tmp_path / "estimates.jsonl"
    write_estimates(estimates, build.estimates(records, {'<b>&"method': 1.0}, rng))
    write_report(folder, estimates, run_benchmark(folder, estimates), tmp_path / "report.html")
    page = ParsedPage((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.open_tags == []
    assert "b" not in page.tags


def test_a_page_without_a_single_pose(dataset: DatasetFixture, tmp_path: Path) -> None:
    folder, records = dataset
    estimates = tmp_path / "estimates.jsonl"
    write_estimates(estimates, [NoFix(frame_index=r.frame_index, method="blind", reason="dark") for r in records])
    result = run_benchmark(folder, estimates)
    write_report(folder, estimates, result, tmp_path / "report.html")
    assert best_method(result.methods) is None
    assert "None of the methods found a pose" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_panels_are_well_formed_and_leave_no_trace(scored: tuple[Path, Path, BenchmarkResult]) -> None:
    before = dict(matplotlib.rcParams)
    panels = [error_panel(scored[2], quantity) for quantity in QUANTITIES]
    assert dict(matplotlib.rcParams) == before
    ids: list[str] = []
    for panel in panels:
        root = ElementTree.fromstring(panel)
        ids += [element.attrib["id"] for element in root.iter() if "id" in element.attrib]
        assert root.attrib["viewBox"]
        assert "currentColor" in panel
    assert len(ids) == len(set(ids))


def test_every_method_looks_different() -> None:
    names = [f"method-{k}" for k in range(13)]
    styles = method_styles(names)
    assert len({style.color for style in styles.values()}) == 13
    assert len({style.marker for style in styles.values()}) == 13


def test_many_methods_still_look_different() -> None:
    styles = method_styles([f"method-{k}" for k in range(169)])
    assert len({(style.color, style.marker) for style in styles.values()}) == 169


def test_thirteen_methods_get_larger_panels_with_the_bound(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    estimates = tmp_path / "estimates.jsonl"
    write_estimates(estimates, build.estimates(records, {f"method-{k}": 1.0 + k for k in range(13)}, rng))
    result = run_benchmark(folder, estimates)
    write_report(folder, estimates, result, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<div class="panels large">' in text
    panel = error_panel(result, QUANTITIES[0])
    assert all(style.color in panel for style in method_styles(list(result.methods)).values())
    # The bound is the one dashed line.
    assert panel.count("stroke-dasharray: ") == 1


def test_a_method_with_covariances_gets_a_table_of_them(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    estimates = tmp_path / "estimates.jsonl"
    plain = [estimate for estimate in build.estimates(records, {"joint": 1.0}, rng) if estimate.status == "fix"]
    write_estimates(estimates, [e.model_copy(update={"covariance": 1e-6 * np.eye(6)}) for e in plain])
    write_report(folder, estimates, run_benchmark(folder, estimates), tmp_path / "report.html")
    assert 'id="table-nees"' in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_sentences_name_the_best_method(scored: tuple[Path, Path, BenchmarkResult]) -> None:
    result = scored[2]
    assert best_method(result.methods) == "joint"
    text = " ".join(result_sentences(result))
    assert three_digits(1e3 * result.methods["joint"].overall.position_mean_m) in text
    assert "9 stereo pairs from 2 to 30 m" in text
    assert "in 0 of 1 pairs without a drogue" in text


def test_the_box_stands_where_the_record_has_it(build: SimpleNamespace) -> None:
    """The box is drawn where the record has it, near and far."""
    for distance_m in (1.7, 20.0):
        record = build.record(0, build.pose(0.1, 0.0, distance_m))
        black = np.zeros((build.rig.camera.height_px, build.rig.camera.width_px, 3), np.uint8)
        box = record.views.left.box_visible_xywh_px
        tile = label_picture(black, box, [marker.center_ellipse_px for marker in record.views.left.markers])
        assert tile.shape == (300, 400, 3)
        scale = 400 / 1280
        edge = tile[:, round((box[0] + 0.5) * scale - 0.5)]
        # The yellow left edge of the box runs down this column, blurred over two by smoothing.
        assert edge[:, 0].max() > 60


def page_with(folder: Path, estimates: Sequence[Estimate], out: Path) -> str:
    """The page of a file of estimates in the folder of `out`."""
    write_estimates(out / "estimates.jsonl", estimates)
    write_report(folder, out / "estimates.jsonl", run_benchmark(folder, out / "estimates.jsonl"), out / "page.html")
    return (out / "page.html").read_text(encoding="utf-8")


def test_without_a_pose_there_are_words_instead_of_empty_axes(dataset: DatasetFixture, tmp_path: Path) -> None:
    folder, records = dataset
    text = page_with(folder, [NoFix(frame_index=r.frame_index, method="n", reason="dark") for r in records], tmp_path)
    assert "No method found a pose, so there is no error to draw." in text
    assert "<svg" not in text and "Cramér–Rao bound</span>" not in text


def test_an_error_of_zero_is_told_where_an_axis_cannot_show_it(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path
) -> None:
    folder, records = dataset
    exact = [
        PoseEstimate(frame_index=r.frame_index, method="exact", left_from_drogue=r.left_from_drogue)
        for r in records
        if r.left_from_drogue is not None
    ]
    text = page_with(folder, exact, tmp_path)
    assert text.count("every error is 0") == len(QUANTITIES)
    assert "An error of exactly 0 has no place on a logarithmic axis" in text
    # Without centroids no bound is known.
    assert "Cramér–Rao bound</span>" not in text


def test_the_legend_names_the_bound_that_is_drawn(page_text: str) -> None:
    assert "Cramér–Rao bound</span>" in page_text
    assert "An error of exactly 0" not in page_text


def test_tiles_span_the_distances(dataset: DatasetFixture) -> None:
    tiles = contact_tiles(Dataset(dataset[0]), count=3)
    assert [tile.distance_m for tile in tiles] == [2.0, 8.0, 30.0]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0012345, "0.00123"),
        (12.345, "12.3"),
        (999.96, "1000"),
        (123456.0, "123000"),
        (-0.5, "−0.500"),
        (0.0, "0.00"),
        (None, "–"),
    ],
)
def test_three_digits(value: float | None, text: str) -> None:
    assert three_digits(value) == text


def test_numbers_for_readers() -> None:
    assert plain_number(2.0) == "2"
    assert plain_number(40.0) == "40"
    assert distance_text(1.7, 1.7) == "1.7 m"
    assert distance_text(1.7, 2.4) == "1.7–2.4 m"
    assert percent(0.9999) == "99.9 %"
    assert percent(1.0) == "100 %"


def test_long_tables_are_folded_under_their_titles_and_short_ones_stand_open(
    build: SimpleNamespace, dataset: DatasetFixture, tmp_path: Path, rng: np.random.Generator
) -> None:
    folder, records = dataset
    estimates = tmp_path / "estimates.jsonl"
    write_estimates(estimates, build.estimates(records, {f"method-{k}": 1.0 for k in range(9)}, rng))
    result = run_benchmark(folder, estimates)
    write_report(folder, estimates, result, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    titles = re.findall(r"<summary>(.+?) <span>(\d+) rows</span></summary>", text)
    rows = sum(len(method.bins) for method in result.methods.values())
    assert ("Z, depth [mm]", str(rows)) in titles
    folded = "".join(re.findall(r"<details>.*?</details>", text, re.DOTALL))
    assert 'id="table-z" aria-label="Z, depth [mm]"' in folded
    assert 'id="table-overall"' in text
    assert 'id="table-overall"' not in folded
