"""`droguekit report`: what it writes, what it leaves out, what it refuses."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape
from pathlib import Path
from typing import Literal

import pytest

from droguekit.cli.main import COMMANDS, DONE, WRONG_INPUT, load_command, run
from droguekit.scoring.results.detection_result import (
    DetectionDataset,
    DetectionResult,
    DetectionRow,
    DetectorResult,
    PairTimes,
)
from studies.paper.paper_report import ReportInputs, missing_parts
from tests.support.parsed_page import ParsedPage

WriteEstimates = Callable[..., Path]


@pytest.fixture(scope="module")
def whole_page(
    docking: Path, bench: Path, estimates_of: WriteEstimates, tmp_path_factory: pytest.TempPathFactory
) -> str:
    errors = {"joint-hub": (0, 0, 1e-4), "paper": (0, 1e-3, 0), "joint-hub+filter": (0, 0, 2e-4)}
    flown, measured = estimates_of(docking, errors), estimates_of(bench, errors)
    out = tmp_path_factory.mktemp("page") / "new" / "report.html"
    options = ["--docking", f"{docking}:{flown}", "--docking", f"{docking}:{flown}", "--docking-sequence", "1"]
    # Twice the same, as when two engines made it.
    options += [
        "--semi-physical",
        f"{bench}:{measured}",
        "--semi-physical",
        f"{bench}:{measured}",
        "--corpus",
        str(bench),
        "--html",
        str(out),
    ]
    assert run(["report", *options]) == DONE
    return out.read_text(encoding="utf-8")


def test_the_page_needs_nothing_from_outside_and_is_well_formed(whole_page: str) -> None:
    page = ParsedPage(whole_page)
    assert page.open_tags == []
    assert not set(page.tags) & {"script", "link", "iframe", "object"}
    assert len(page.ids) == len(set(page.ids))
    assert all(reference.startswith(("#", "data:image/jpeg;base64,")) for reference in page.references)
    assert {reference[1:] for reference in page.references if reference.startswith("#")} <= set(page.ids)
    assert not re.search(r"https?:|@import|url\((?!#)", re.sub(r"data:image/jpeg;base64,[\w+/=]+", "", whole_page))


def test_the_page_has_its_parts_and_says_what_is_missing(whole_page: str) -> None:
    for anchor in ("claims", "contradiction", "table-2", "left-out", "figure-10"):
        assert f'id="{anchor}"' in whole_page
    for anchor in ("table-docking-errors", "worst", "table-times", "figure-16", "figure-17", "figure-18", "figure-19"):
        assert f'id="{anchor}-1"' in whole_page and f'id="{anchor}-2"' in whole_page
    assert 'id="table-1"' not in whole_page and "Table 1 and Figure 11:" in whole_page
    assert "Sequence 1 of docking-10m, analytic: 2 pairs" in whole_page
    assert "no estimates of mono-circle, circle-fit" in whole_page
    # 0.1 mm was put in, and the published number stands beside.
    assert "0.100 mm" in whole_page and "21.4 mm" in whole_page
    assert "ours, filtered" in whole_page


def test_brackets_are_told_where_there_are_means_with_intervals(
    whole_page: str, bench: Path, estimates_of: WriteEstimates, tmp_path: Path
) -> None:
    measured = estimates_of(bench, {"joint-hub": (0, 0, 1e-4)})
    assert run(["report", "--semi-physical", f"{bench}:{measured}", "--html", str(tmp_path / "bench.html")]) == DONE
    told = "its 95 % confidence interval"
    # Of the bench there is a pair of numbers in the same place, against the reading and the truth.
    assert told in whole_page and told not in (tmp_path / "bench.html").read_text(encoding="utf-8")


def test_everything_measured_names_its_dataset_and_engine(whole_page: str) -> None:
    """Or two engines' numbers could not be told apart."""
    claims = re.findall(r"<tr><th>([^<]*)</th><td class=\"published\"", whole_page)
    assert len(claims) == 2 * 4 + 2 * 2
    assert all("docking-10m, analytic" in claim or "semi-physical-7, analytic" in claim for claim in claims)
    titles = re.findall(
        r"<caption><span>([^<]*)</span>|<p class=\"under\">([^<]*)</p>\s*<ul class=\"legend\">", whole_page
    )
    told = [table or figure for table, figure in titles]
    assert sum("docking-10m, analytic" in text for text in told) >= 2 * (1 + 3)
    assert sum("semi-physical-7, analytic" in text for text in told) >= 2
    assert re.search(r"docking-10m, analytic, 8 pairs", whole_page) and "numpy" in whole_page
    assert "this machine" not in whole_page


def test_the_page_is_the_same_every_time(bench: Path, estimates_of: WriteEstimates, tmp_path: Path) -> None:
    estimates = estimates_of(bench, {"joint-hub": (0, 0, 1e-4)})
    for name in ("a.html", "b.html"):
        assert run(["report", "--semi-physical", f"{bench}:{estimates}", "--html", str(tmp_path / name)]) == DONE
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_names_of_files_cannot_break_the_page(bench: Path, estimates_of: WriteEstimates, tmp_path: Path) -> None:
    hostile = tmp_path / "<b>&'x'.jsonl"
    estimates_of(bench, {"paper": (0, 0, 1e-4)}).rename(hostile)
    assert run(["report", "--semi-physical", f"{bench}:{hostile}", "--html", str(tmp_path / "r.html")]) == DONE
    page = ParsedPage((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert page.open_tags == [] and "b" not in page.tags


def test_commands_that_are_told_exist() -> None:
    commands = [unescape(command) for part in missing_parts(ReportInputs()) for command in part.commands]
    commands += [f"droguekit report {part.option}" for part in missing_parts(ReportInputs())]
    assert len(commands) >= 8
    for command in commands:
        program, name, *words = command.split()
        assert program == "droguekit" and name in COMMANDS
        options = {option for parameter in load_command(name).params for option in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= options, command


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--detection", "d.json"], "--html, --pdf: give at least one"),
        (["--html", "{out}"], "nothing to report on"),
        (["--docking", "x", "--html", "{out}"], "--docking: must be DIR:FILE.jsonl"),
        (["--docking-sequence", "1", "--html", "{out}"], "--docking-sequence: needs --docking"),
        (["--semi-physical", "dataset", "--html", "{out}"], "--semi-physical: must be DIR:FILE.jsonl"),
        (["--semi-physical", "s3://bucket/x", "--html", "{out}"], "--semi-physical: must be DIR:FILE.jsonl"),
        (["--detection", "{here}/none.json", "--html", "{out}"], "none.json: cannot be read"),
        (["--detection", "{here}/bad.json", "--html", "{out}"], "bad.json: holds no detection scores"),
        (["--corpus", "{here}/none", "--html", "{out}"], "none: there is no such dataset folder"),
        (
            ["--corpus", "{here}/none", "--html", "{out}", "--pdf", "{here}/../{name}/out.html"],
            "--pdf: must be another file than --html",
        ),
    ],
)
def test_wrong_input_is_one_line(
    options: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.json").write_text('{"schema": 1, "methods": {}}', encoding="utf-8")
    out = tmp_path / "out.html"
    words = [option.format(out=out, here=tmp_path, name=tmp_path.name) for option in options]
    assert run(["report", *words]) == WRONG_INPUT
    said = capsys.readouterr().err.strip()
    assert told in said and "\n" not in said
    assert not out.exists()


@pytest.mark.parametrize("option", ["--html", "--pdf"])
def test_no_input_is_replaced(
    bench: Path, estimates_of: WriteEstimates, tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    estimates = estimates_of(bench, {"joint-hub": (0, 0, 1e-4)})
    link = tmp_path / "link.jsonl"
    link.symlink_to(estimates)
    before, manifest = estimates.read_bytes(), (bench / "manifest.json").read_bytes()
    for out, told in (
        (estimates, "is an input"),
        (link, "is an input"),
        (bench / "manifest.json", "lies in a dataset"),
    ):
        assert run(["report", "--semi-physical", f"{bench}:{estimates}", option, str(out)]) == WRONG_INPUT
        said = capsys.readouterr().err
        assert f"{option}: " in said and told in said and said.count("\n") == 1
    assert estimates.read_bytes() == before and (bench / "manifest.json").read_bytes() == manifest


def scores(threshold_from: Literal["val", "scored images"], split: str) -> DetectionResult:
    row = DetectionRow(
        images=40,
        boxes=30,
        scenes=5,
        ap=0.6,
        ap50=0.9,
        ap75=0.5,
        ap50_interval=None,
        precision=0.8,
        recall=0.7,
        recall_interval=(0.5, 0.9),
        note="few scenes",
    )
    detector = DetectorResult(
        operating_threshold=0.425,
        threshold_from=threshold_from,
        overall=row,
        best_f1=None,
        false_alarms=None,
        distances=(),
        families={},
        eyes={},
        splits={},
        times=PairTimes(wall_ms=20, cpu_ms=20, pairs=20),
    )
    facts = DetectionDataset(
        name="corpus-a", sha256="0" * 64, split=split, images=40, boxes=30, ignored=0, empty_frames=4
    )
    return DetectionResult(
        dataset=facts, code_version="9.8.7", confidence=0.95, least_seen_fraction=0.1, detectors={"net": detector}
    )


def test_detection_tells_its_images_and_its_threshold(tmp_path: Path) -> None:
    pages = []
    for threshold_from, split in (("val", "test"), ("scored images", "all")):
        path, out = tmp_path / "scores.json", tmp_path / "page.html"
        path.write_text(scores(threshold_from, split).to_json(), encoding="utf-8")
        assert run(["report", "--detection", str(path), "--html", str(out)]) == DONE
        pages.append(unescape(out.read_text(encoding="utf-8")))
    # In the table, the figure's caption, both claims, and what the page rests on.
    assert pages[0].count("40 images of corpus-a, split test") == 5
    assert "40 images of corpus-a, all splits" in pages[1]
    assert "at least 0.425, the best F1 on the split val (few scenes)." in pages[0]
    assert "the best F1 on the scored images themselves, which flatters" in pages[1]
    assert "droguekit 9.8.7" in pages[0] and "on the machine that made the scores (not named in the file)" in pages[0]
    assert "ours-l (the paper's)" in pages[0]


def test_the_page_is_written_although_nothing_can_print_it(
    bench: Path,
    estimates_of: WriteEstimates,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    estimates = estimates_of(bench, {"joint-hub": (0, 0, 1e-4)})
    monkeypatch.setenv("PATH", str(tmp_path))
    options = ["--semi-physical", f"{bench}:{estimates}", "--html", str(tmp_path / "r.html")]
    assert run(["report", *options, "--pdf", str(tmp_path / "r.pdf")]) == WRONG_INPUT
    assert (tmp_path / "r.html").stat().st_size > 10_000 and not (tmp_path / "r.pdf").exists()
    said = capsys.readouterr()
    assert "r.html" in said.out
    assert said.err.count("\n") == 1 and "a PDF needs Chromium or Chrome" in said.err
