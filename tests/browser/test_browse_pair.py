"""One pair of a dataset's page in a browser: overlays where the labels say, keys, zoom, estimates without truth."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.types.estimates import PoseEstimate
from datasets_manifest.types.records import PairRecord
from drogue_models.marker_layout import marker_layout
from droguekit.batch.progress import PlainProgress
from droguekit.cli.main import DONE, run
from droguekit.visualization.browse.page import write_browse
from geometry.circles import disc_outline
from geometry.se3 import RigidTransform
from geometry.stereo import EYES
from tests.support.browsed_dataset import OTHER, BrowsedDataset, show, shown_frames

OpenPage = Callable[..., Any]
# Labels are rounded to a thousandth of a pixel, outlines to a tenth of that.
PX = 0.01


def corners(page: Any, selector: str) -> list[np.ndarray]:
    """(M, 2) of every polygon."""
    texts = page.eval_on_selector_all(selector, "all => all.map(p => p.getAttribute('points'))")
    return [np.array([pair.split(",") for pair in text.split()], dtype=float) for text in texts]


def crosses(page: Any, selector: str) -> np.ndarray:
    """(M, 2) places."""
    texts = page.eval_on_selector_all(selector, "all => all.map(p => p.getAttribute('transform'))")
    found = [re.match(r"translate\(([-\d.e]+) ([-\d.e]+)\)", text) for text in texts]
    return np.array([match.groups() for match in found if match], dtype=float).reshape(-1, 2)


def drogue_outlines(record: PairRecord, pose: RigidTransform, eye: str) -> list[np.ndarray]:
    """Rim, opening, markers and hub through the rig's own cameras, written apart from the page's."""
    drogue = record.frame.drogue
    layout = marker_layout(drogue)
    discs = [((0, 0, 0), drogue.rim_radius_m, 96), ((0, 0, 0), drogue.face_inner_radius_m, 96)]
    discs += [(center, layout.radius_m, 32) for center in layout.centers_m]
    discs += [(layout.hub_center_m, radius, 32) for radius in (layout.hub_outer_radius_m, layout.hub_inner_radius_m)]
    return [record.frame.rig.image(disc_outline(pose, *disc), eye) for disc in discs]


def test_names_are_shown_as_they_are(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    opened = open_page(browsed.page)
    opened.page.on("dialog", lambda dialog: opened.faults.append("a foreign script ran"))
    show(opened.page, 4)
    estimates = opened.page.inner_text("#estimates")
    assert OTHER in estimates and "<i>nothing</i> seen" in estimates
    assert opened.page.locator("img[src=x]").count() == 0 and opened.faults == []


def test_overlays_lie_where_the_labels_say(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    opened = open_page(browsed.page)
    page, compared = opened.page, 0
    for index, record in browsed.records.items():
        show(page, index, "truth", "centroids")
        for eye in EYES:
            view = getattr(record.views, eye)
            for kind, box in (("full", view.box_full_xywh_px), ("visible", view.box_visible_xywh_px)):
                found = page.eval_on_selector_all(
                    f"#{eye} rect.{kind}",
                    "all => all.map(r => ['x','y','width','height'].map(n => +r.getAttribute(n)))",
                )
                np.testing.assert_allclose(found, [] if box is None else [box], atol=PX)
            centers = np.array([marker.center_ellipse_px for marker in view.markers]).reshape(-1, 2)
            np.testing.assert_allclose(crosses(page, f"#{eye} .markers path"), centers, atol=PX)
            hub = [] if view.hub is None else [view.hub.center_ellipse_px]
            np.testing.assert_allclose(crosses(page, f"#{eye} .hub path"), np.reshape(hub, (-1, 2)), atol=PX)
            estimate = browsed.estimates["own"][index]
            fix = estimate.left_from_drogue if isinstance(estimate, PoseEstimate) else None
            for name, pose in (("truth", record.left_from_drogue), ("estimate", fix)):
                wanted = [] if pose is None else drogue_outlines(record, pose, eye)
                for found, want in zip(corners(page, f"#{eye} .{name} polygon"), wanted, strict=True):
                    np.testing.assert_allclose(found, want, atol=PX)
                    compared += 1
            measured = [f.center_px for f in estimate.features if f.eye == eye]
            np.testing.assert_allclose(crosses(page, f"#{eye} .centroids path"), np.reshape(measured, (-1, 2)), atol=PX)
            unused = page.locator(f"#{eye} .centroids path.unused")
            assert unused.count() == sum(not f.used for f in estimate.features if f.eye == eye)
    assert compared > 200
    assert opened.faults == []


def test_the_image_lies_under_its_overlay(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page, width_px=1280).page
    # A near drogue in daylight: at the labelled centres the screen shows red.
    index, record = next(
        (i, r)
        for i, r in browsed.records.items()
        if r.conditions.family == "clear" and (r.conditions.distance_m or 99) < 4
    )
    show(page, index)
    for name in ("box", "markers", "hub", "estimate"):
        page.uncheck(f"[name={name}]")
    for eye in EYES:
        shot = page.locator(f"#{eye}").screenshot()
        screen = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR).astype(int)
        scale = screen.shape[1] / 320
        seen = 0
        for marker in getattr(record.views, eye).markers:
            if marker.visible_fraction < 1:
                continue
            x, y = ((c + 0.5) * scale for c in marker.center_ellipse_px)
            blue, green, red = screen[int(y), int(x)]
            # Red paint reflects 18 times as much red as green; sensor, lens and curve leave far more than half again.
            assert red > 1.5 * green and red > 1.5 * blue
            seen += 1
        assert seen >= 4


def test_keys_step_through_what_is_filtered(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    opened = open_page(browsed.page)
    page = opened.page
    page.select_option("#filters [name=family]", "low-light")
    frames = shown_frames(page)
    page.click(f"[data-frame='{frames[0]}']")
    page.wait_for_function("!document.getElementById('one').hidden")
    assert page.inner_text("#title").startswith(f"Frame {frames[0]}, low-light")
    assert page.evaluate("document.activeElement.id") == "title"
    assert page.is_disabled("#previous")
    page.keyboard.press("ArrowRight")
    assert page.inner_text("#title").startswith(f"Frame {frames[1]},")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")  # there is nothing before the first
    assert page.inner_text("#title").startswith(f"Frame {frames[0]},")
    page.keyboard.press("Escape")
    page.wait_for_function("!document.getElementById('all').hidden")
    assert shown_frames(page) == frames
    assert page.evaluate("document.activeElement.dataset.frame") == str(frames[0])
    page.go_back()
    page.wait_for_function("!document.getElementById('one').hidden")
    assert page.is_visible("#title") and page.evaluate("location.hash").endswith(f"frame={frames[0]}")
    assert opened.faults == []


def test_zoom_shows_the_drogue(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page).page
    index, record = max(browsed.records.items(), key=lambda item: item[1].conditions.distance_m or 0)
    show(page, index)
    whole = [float(part) for part in page.get_attribute("#left", "viewBox").split()]
    assert whole == [-0.5, -0.5, 320, 240]
    page.keyboard.press("z")
    assert page.get_attribute("#zoom", "aria-pressed") == "true"
    for eye in EYES:
        x, y, width, height = (float(part) for part in page.get_attribute(f"#{eye}", "viewBox").split())
        box = getattr(record.views, eye).box_visible_xywh_px
        assert x < box[0] and y < box[1] and x + width > box[0] + box[2] and y + height > box[1] + box[3]
        assert width < 120 and width / height == pytest.approx(320 / 240)


def test_pairs_without_truth_show_estimates_alone(browsed: BrowsedDataset, open_page: OpenPage, tmp_path: Path) -> None:
    assert (
        run(["export", str(browsed.folder / "dataset"), "--format", "blind", "--out", str(tmp_path / "blind")]) == DONE
    )
    write_browse(tmp_path / "blind", tmp_path / "page", browsed.folder / "e.jsonl", 0, PlainProgress(io.StringIO()))
    opened = open_page(tmp_path / "page" / "index.html")
    page = opened.page
    fixes = [i for i, estimate in browsed.estimates["own"].items() if isinstance(estimate, PoseEstimate)]
    page.select_option("#filters [name=result]", "fix")
    assert shown_frames(page) == fixes
    assert not page.is_visible("#filters [name=near]")
    show(page, fixes[0])
    assert not page.is_visible("#layers [name=markers]") and page.is_visible("#layers [name=estimate]")
    pose = browsed.estimates["own"][fixes[0]].left_from_drogue
    assert f"a fix at {pose.translation_m[2]:.2f}" in page.inner_text("#estimates")
    page.keyboard.press("z")
    # The estimate's rim fills most of what is shown.
    x, _, width, _ = (float(part) for part in page.get_attribute("#left", "viewBox").split())
    rim = corners(page, "#left .estimate polygon.rim")[0]
    assert x < rim[:, 0].min() and rim[:, 0].max() < x + width < rim[:, 0].min() + 2.5 * np.ptp(rim, axis=0).max()
    assert opened.faults == []


def test_errors_have_three_digits_as_in_reports(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page).page
    texts = page.evaluate("[0.000123456, 0.0, 0.99999, 12.345, 1234.5].map((x) => droguekit.millimetres(x))")
    assert texts == [f"{text}\u00a0mm" for text in ("0.000123", "0.00", "1.00", "12.3", "1230")]
