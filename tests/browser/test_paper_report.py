"""The report on the paper's experiments in a real browser: phone, desktop, dark, and on paper."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, Feature, NoFix, PoseEstimate, Region, write_estimates
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from droguekit.cli.main import DONE, run
from droguekit.scoring.detection.detection_figures import published_name, speed_panel
from droguekit.scoring.detection.detection_tables import PUBLISHED_DETECTORS
from droguekit.workflows.rendering import open_recipe
from geometry.se3 import RigidTransform
from studies.paper.paper_report import read_detection
from studies.paper.published_results import CONTENDERS

pytestmark = pytest.mark.slow
OpenPage = Callable[..., Any]

# Panels of Figures 10 (3), 11 (1), 16 (5), 17 (3), 18 (4) and 19 (4).
PANELS = 20
DOCKING_FRAMES = (0, 1, 2, 4)
SCREENS = ((320, "light"), (360, "dark"), (1280, "light"), (1280, "dark"))


def _render(folder: Path, recipe_name: str, frames: Sequence[int]) -> Path:
    source = open_recipe(recipe_name, None, "analytic")
    told = io.StringIO()
    render_dataset(source, folder, list(frames), 0, PlainProgress(told))
    return folder


def _navigated(dataset: Path, out: Path) -> Path:
    """Poses that err a little, with centroids and boxes, and one pair without a pose."""
    rng, data, estimates = np.random.default_rng(3), Dataset(dataset), list[Estimate]()
    for index in data.frame_indices:
        record = data.record(index)
        pose, view = record.left_from_drogue, record.views.left
        assert pose is not None and view.box_full_xywh_px is not None
        features = tuple(
            Feature(eye="left", index=k, center_px=m.center_ellipse_px, cov_px2=((0.01, 0), (0, 0.01)), used=True)
            for k, m in enumerate(view.markers)
        )
        region = Region(eye="left", box_xywh_px=view.box_full_xywh_px, source="detector", score=0.9)
        for k, contender in enumerate(CONTENDERS):
            if index == 2 and k == 1:
                estimates.append(NoFix(frame_index=index, method=contender.method, reason="too few markers matched"))
                continue
            moved = RigidTransform(pose.rotation, pose.translation_m + rng.normal(0, 1e-3 * (k + 1), 3))
            estimates.append(
                PoseEstimate(
                    frame_index=index,
                    method=contender.method,
                    left_from_drogue=moved,
                    features=features,
                    regions=(region,),
                    stage_s={"detect": 0.01, "centroids": 0.004, "correspond": 0.001, "refine": 0.02, "pose": 0.002},
                    latency_s=0.04,
                )
            )
    write_estimates(out, estimates)
    return out


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole page, every part of it given."""
    folder = tmp_path_factory.mktemp("report")
    docking = _render(folder / "docking", "docking-10m", DOCKING_FRAMES)
    bench = _render(folder / "bench", "semi-physical-7", (0, 1))
    flown, measured = (_navigated(data, data.with_suffix(".jsonl")) for data in (docking, bench))
    scores, page = folder / "detection.json", folder / "report.html"
    assert run(["benchmark", str(bench), "--detector", "color-blob", "--json", str(scores)]) == DONE
    options = ["--docking", f"{docking}:{flown}", "--semi-physical", f"{bench}:{measured}"]
    options += ["--detection", str(scores), "--corpus", str(bench)]
    assert run(["report", *options, "--html", str(page)]) == DONE
    return page


@pytest.mark.parametrize(("width_px", "scheme"), SCREENS)
def test_nothing_is_wrong_at_any_width(open_page: OpenPage, report: Path, width_px: int, scheme: str) -> None:
    opened = open_page(report, width_px=width_px, scheme=scheme)
    assert opened.faults == []
    assert opened.requests == []
    assert opened.overflows() == []
    too_faint = [text for text in opened.contrasts() if not text.is_enough]
    assert too_faint == []


@pytest.mark.parametrize("width_px", [320, 1280])
def test_every_figure_is_drawn_and_can_be_read(open_page: OpenPage, report: Path, width_px: int) -> None:
    opened = open_page(report, width_px=width_px)
    figures = opened.figures()
    worst = [figure for figure in figures if figure.label.startswith("worst frame")]
    panels = [figure for figure in figures if figure not in worst]
    assert (len(panels), len(worst)) == (PANELS, len(DOCKING_FRAMES))
    for figure in figures:
        assert figure.width_px > 200 and figure.height_px > 100, figure
    # A frame, ticks and data; a picture, two models, box and centroids.
    assert all(figure.shapes >= 8 for figure in panels)
    assert all(figure.shapes >= 5 for figure in worst)
    # On the narrowest phone figures stand a little smaller than drawn; below 8 px letters are guessed, not read.
    assert all(figure.least_text_px >= 8 for figure in panels)
    assert all(figure.text_outside_px < 8 for figure in panels)
    assert [figure.text_overlaps for figure in figures if figure.text_overlaps] == []


@pytest.mark.parametrize("width_px", [320, 360])
def test_titles_of_tables_stay_in_sight(open_page: OpenPage, report: Path, width_px: int) -> None:
    """Also when a wide table is pushed all the way to the left."""
    opened = open_page(report, width_px=width_px)
    for pushed in (False, True):
        places = opened.page.evaluate(
            """(pushed) => {
              if (pushed) document.querySelectorAll(".wide").forEach((e) => { e.scrollLeft = e.scrollWidth; });
              return [...document.querySelectorAll("caption > span, tr.group th > span")]
                .map((span) => span.getBoundingClientRect()).map((box) => [box.left, box.right]);
            }""",
            pushed,
        )
        assert len(places) >= 8
        assert all(left >= 0 and right <= width_px for left, right in places), places


@pytest.mark.parametrize(("ap50", "image_ms"), [(0.99, 12.0), (0.2, 3.0), (0.97, 600.0), (0.0, 4000.0)])
def test_names_in_figure_11_stand_apart(
    open_page: OpenPage, report: Path, tmp_path: Path, ap50: float, image_ms: float
) -> None:
    """Wherever the measured detector lies, and so however small a part of the panel the published ones fill."""
    result = read_detection(report.with_name("detection.json"))
    ((name, detector),) = result.detectors.items()
    assert detector.times is not None
    overall = detector.overall.model_copy(update={"ap50": ap50})
    times = detector.times.model_copy(update={"wall_ms": 2 * image_ms})
    moved = result.model_copy(
        update={"detectors": {name: detector.model_copy(update={"overall": overall, "times": times})}}
    )
    page = tmp_path / "page.html"
    html = f'<!DOCTYPE html><html lang="en"><title>t</title><body>{speed_panel(moved)}</body></html>'
    page.write_text(html, encoding="utf-8")
    # At its drawn size: 4.4 inches, which are 423 px.
    (figure,) = open_page(page, width_px=440).figures()
    assert figure.text_overlaps == [] and figure.text_outside_px < 8
    texts = {text.strip() for text in open_page(page).page.locator("svg text").all_text_contents()}
    assert all(published_name(row.name) in texts for row in PUBLISHED_DETECTORS)


def test_lines_stand_out_in_both_palettes(open_page: OpenPage, report: Path) -> None:
    """Each method's line against the page: WCAG asks for 3 to 1 of parts of a figure."""
    for scheme in ("light", "dark"):
        opened = open_page(report, scheme=scheme)
        ratios = opened.page.evaluate(
            """() => {
              const rgb = (text) => text.match(/[\\d.]+/g).slice(0, 3).map(Number);
              const light = (c) => c.map((v) => v / 255)
                .map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
                .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
              const page = light(rgb(getComputedStyle(document.body).backgroundColor));
              return [...document.querySelectorAll(".legend svg path")]
                .map((path) => getComputedStyle(path).stroke).filter((stroke) => stroke.startsWith("rgb"))
                .map((stroke) => light(rgb(stroke)))
                .map((line) => (Math.max(line, page) + 0.05) / (Math.min(line, page) + 0.05));
            }"""
        )
        # The keys of the pictures' lines stand on chips of their own.
        chips = opened.page.locator(".chip path").count()
        assert len(ratios) > chips and min(ratios[:-chips]) >= 3.0


def test_it_prints_light_on_whole_pages_and_nothing_is_cut_off(
    open_page: OpenPage, report: Path, tmp_path: Path
) -> None:
    opened = open_page(report, scheme="dark")
    # A4 less margins of 12 mm, at 96 px an inch.
    opened.resize(703, media="print")
    assert opened.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert opened.page.evaluate("getComputedStyle(document.body).color") == "rgb(0, 0, 0)"
    assert opened.overflows() == []
    clipped = opened.page.evaluate(
        """() => [...document.querySelectorAll(".wide, table")]
          .filter((e) => e.scrollWidth > document.documentElement.clientWidth).map((e) => e.id || e.className)"""
    )
    assert clipped == []
    pages = opened.print_pdf(tmp_path / "report.pdf")
    assert 5 <= len(pages) <= 15
    assert {(round(page.width_pt), round(page.height_pt)) for page in pages} == {(595, 842)}
