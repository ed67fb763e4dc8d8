"""The page of a dataset in a browser: no faults, filters that count right, overlays where the labels say."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser

from datasets_manifest.estimates import Estimate, Feature, NoFix, PoseEstimate, write_estimates
from datasets_manifest.reader import Dataset
from datasets_manifest.recipe import parse_recipe
from datasets_manifest.records import PairRecord
from drogue_models.marker_layout import marker_layout
from droguekit.batch.local import render_dataset
from droguekit.batch.progress import PlainProgress
from droguekit.browse.browse import write_browse
from droguekit.cli.main import DONE, run
from geometry.circles import disc_outline
from geometry.se3 import RigidTransform
from geometry.stereo import EYES

OpenPage = Callable[..., Any]

# Real lenses: an overlay that knew only the ideal camera would be off by pixels.
RECIPE = """
name = "page"
seed = 4
[rig]
preset = "paper-real"
width_px = 320
height_px = 240
focal_px = 533.0
[frames]
count = 12
scenes = 4
empty_fraction = 0.2
[distance]
law = "log-uniform"
low_m = 1.9
high_m = 9.0
[split]
train = 0.5
val = 0.25
test = 0.25
[render]
engine = "analytic"
[[families]]
name = "clear"
weight = 1
environment = {sun_elevation_deg = [20, 60]}
[[families]]
name = "low-light"
weight = 1
environment = {sun_elevation_deg = [-8, -2]}
"""
PAIRS = 12
OTHER = "</script><img src=x onerror=alert(1)>"
ERRORS_M = 1e-3 * np.array([0.0, 1.0, 0.5])
# Labels are rounded to a thousandth of a pixel, outlines to a tenth of that.
PX = 0.01


# Names that a script's objects have already.
HOSTILE = ("__proto__", "constructor")


class BrowsedDataset(NamedTuple):
    """A folder with a dataset, its page and the estimates on it by method and frame."""

    folder: Path
    records: dict[int, PairRecord]
    splits: dict[int, str]
    page: Path
    estimates: dict[str, dict[int, Estimate]]


def invent_estimate(record: PairRecord, method: str) -> Estimate:
    """A pose that is off by more in later frames; every fifth is no fix, and so is that of an empty frame."""
    index, pose = record.frame_index, record.left_from_drogue
    if pose is None or index % 5 == 4:
        return NoFix(frame_index=index, method=method, reason="<i>nothing</i> seen")
    moved = RigidTransform(pose.rotation, pose.translation_m + index * ERRORS_M * (1 if method == "own" else -2))
    features = [
        Feature(eye="right", index=k, center_px=marker.center_ellipse_px, cov_px2=((1, 0), (0, 1)), used=k > 0)
        for k, marker in enumerate(record.views.right.markers)
    ]
    return PoseEstimate(frame_index=index, method=method, left_from_drogue=moved, features=tuple(features))


@pytest.fixture(scope="module")
def browsed(tmp_path_factory: pytest.TempPathFactory) -> BrowsedDataset:
    folder = tmp_path_factory.mktemp("<b>&amp; 'page\" #1%20")
    told = PlainProgress(io.StringIO())
    render_dataset(parse_recipe(RECIPE), RECIPE, folder / "dataset", range(PAIRS), 0, told)
    dataset = Dataset(folder / "dataset")
    records = {index: dataset.record(index) for index in dataset.frame_indices}
    estimates = {m: {i: invent_estimate(r, m) for i, r in records.items()} for m in ("own", OTHER, *HOSTILE)}
    write_estimates(folder / "e.jsonl", [estimate for found in estimates.values() for estimate in found.values()])
    summary = write_browse(folder / "dataset", folder / "page", folder / "e.jsonl", 0, told)
    assert (summary.shown, summary.skipped) == (PAIRS, ())
    return BrowsedDataset(
        folder, records, dict(dataset.manifest.split_of_frame()), folder / "page" / "index.html", estimates
    )


def shown_frames(page: Any) -> list[int]:
    return [int(frame) for frame in page.eval_on_selector_all("#tiles a", "all => all.map(a => a.dataset.frame)")]


def show(page: Any, frame: int, *wanted: str) -> None:
    """Open a pair and tick all layers; wait until its labels are drawn."""
    page.evaluate(f"location.hash = 'frame={frame}'")
    page.wait_for_selector(f"#left[aria-label^='Frame {frame},']", state="attached")
    for name in wanted:
        page.check(f"[name={name}]")


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


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width_px", [360, 1280])
def test_the_page_has_no_fault_at_any_width(
    browsed: BrowsedDataset, open_page: OpenPage, width_px: int, scheme: str
) -> None:
    opened = open_page(browsed.page, width_px=width_px, scheme=scheme)
    for look in ("list", "single"):
        if look == "single":
            show(opened.page, 1)
        assert opened.overflows() == []
        faint = [text for text in opened.contrasts("body *:not(:disabled)") if not text.is_enough]
        assert faint == []
    assert opened.faults == []
    assert opened.requests and opened.requests_outside(browsed.page.parent) == []


def test_names_are_shown_as_they_are(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    opened = open_page(browsed.page)
    opened.page.on("dialog", lambda dialog: opened.faults.append("a foreign script ran"))
    show(opened.page, 4)
    answers = opened.page.inner_text("#answers")
    assert OTHER in answers and "<i>nothing</i> seen" in answers
    assert opened.page.locator("img[src=x]").count() == 0 and opened.faults == []


@pytest.mark.parametrize("method", HOSTILE)
def test_a_method_may_be_called_as_a_script_calls_its_own_things(
    browsed: BrowsedDataset, open_page: OpenPage, method: str
) -> None:
    opened = open_page(browsed.page)
    page = opened.page
    fixes = [i for i, estimate in browsed.estimates[method].items() if isinstance(estimate, PoseEstimate)]
    page.select_option("#filters [name=method]", method)
    page.select_option("#filters [name=answer]", "fix")
    assert shown_frames(page) == fixes
    page.select_option("#filters [name=order]", "error")
    assert shown_frames(page) == sorted(fixes, reverse=True)
    show(page, fixes[0])
    assert page.locator("#left .estimate polygon.rim").count() == 1
    page.evaluate(f"location.hash = 'order={method}'")
    page.wait_for_function("!document.getElementById('all').hidden")
    assert shown_frames(page) == sorted(browsed.records)
    assert opened.faults == []


def test_filters_count_as_numpy_does(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page).page
    records = list(browsed.records.values())
    index = np.array([record.frame_index for record in records])
    distance = np.array([record.conditions.distance_m or np.nan for record in records])
    family = np.array([record.conditions.family for record in records])
    split = np.array([browsed.splits[i] for i in index])
    luminance = np.array([record.conditions.background_luminance_cd_m2 for record in records])
    box = np.array([record.views.left.box_visible_xywh_px is not None for record in records])
    fix = np.array([isinstance(browsed.estimates[OTHER][i], PoseEstimate) for i in index])
    cases = [
        ({"near": "3.5"}, distance >= 3.5),
        ({"far": "3.5"}, distance <= 3.5),
        ({"near": "3", "far": "6", "family": "clear"}, (distance >= 3) & (distance <= 6) & (family == "clear")),
        ({"family": "low-light"}, family == "low-light"),
        ({"split": "val"}, split == "val"),
        ({"drogue": "none"}, np.isnan(distance)),
        ({"drogue": "seen"}, box),
        ({"light": "1 to 100 cd/m²"}, (luminance >= 1) & (luminance < 100)),
        ({"light": "from 3000 cd/m²"}, luminance >= 3000),
        ({"method": OTHER, "answer": "fix"}, fix),
        ({"answer": "none"}, ~fix),
        ({"text": "LOW-LIGHT val"}, (family == "low-light") & (split == "val")),
        ({"text": "nothing like that"}, index < 0),
    ]
    assert all(0 < wanted.sum() < len(index) for _, wanted in cases[:2])
    for fields, wanted in cases:
        page.click("button[type=reset]")
        for name, value in fields.items():
            field = page.locator(f"#filters [name={name}]")
            if field.evaluate("e => e.tagName") == "SELECT":
                # A class of light that no pair has is not offered.
                if field.locator("option").evaluate_all("(all, v) => all.every(o => o.value !== v)", value):
                    assert not wanted.any()
                    break
                field.select_option(value)
            else:
                field.fill(value)
        else:
            assert page.inner_text("#count") == f"{wanted.sum()} of {PAIRS} pairs", fields
            assert shown_frames(page) == index[wanted].tolist(), fields


def test_numbers_are_typed_from_left_to_right(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page).page
    distances = [record.conditions.distance_m for record in browsed.records.values()]
    field = page.locator("#filters [name=near]")
    field.press_sequentially("3.5")
    assert field.input_value() == "3.5"
    wanted = sum(distance is not None and distance >= 3.5 for distance in distances)
    assert page.inner_text("#count") == f"{wanted} of {PAIRS} pairs"


def test_a_number_finds_its_frame_and_no_other(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page).page
    page.fill("#filters [name=text]", "11")
    assert shown_frames(page) == [11]


def test_orders_are_those_of_the_numbers(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    page = open_page(browsed.page).page
    full = {i: r.conditions.distance_m for i, r in browsed.records.items() if r.conditions.distance_m is not None}
    page.select_option("#filters [name=order]", "near")
    assert shown_frames(page)[: len(full)] == sorted(full, key=lambda i: full[i])
    page.select_option("#filters [name=order]", "far")
    assert shown_frames(page)[: len(full)] == sorted(full, key=lambda i: -full[i])
    fixes = [i for i, estimate in browsed.estimates["own"].items() if isinstance(estimate, PoseEstimate)]
    page.select_option("#filters [name=order]", "error")
    assert shown_frames(page)[: len(fixes)] == sorted(fixes, reverse=True)


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
    page.select_option("#filters [name=answer]", "fix")
    assert shown_frames(page) == fixes
    assert not page.is_visible("#filters [name=near]")
    show(page, fixes[0])
    assert not page.is_visible("#layers [name=markers]") and page.is_visible("#layers [name=estimate]")
    pose = browsed.estimates["own"][fixes[0]].left_from_drogue
    assert f"a fix at {pose.translation_m[2]:.2f}" in page.inner_text("#answers")
    page.keyboard.press("z")
    # The estimate's rim fills most of what is shown.
    x, _, width, _ = (float(part) for part in page.get_attribute("#left", "viewBox").split())
    rim = corners(page, "#left .estimate polygon.rim")[0]
    assert x < rim[:, 0].min() and rim[:, 0].max() < x + width < rim[:, 0].min() + 2.5 * np.ptp(rim, axis=0).max()
    assert opened.faults == []


def test_a_link_opens_its_pair_and_a_wrong_one_the_list(browsed: BrowsedDataset, open_page: OpenPage) -> None:
    opened = open_page(browsed.page)
    opened.page.goto(browsed.page.as_uri() + "#frame=7")
    opened.page.wait_for_selector("#left[aria-label^='Frame 7,']", state="attached")
    assert opened.page.inner_text("#title").startswith("Frame 7,")
    conditions = opened.page.inner_text("#conditions")
    assert browsed.records[7].conditions.family in conditions and browsed.records[7].engine_version in conditions
    for wrong in ("99", "-1", "x", "__proto__"):
        opened.page.goto(browsed.page.as_uri() + f"#frame={wrong}")
        opened.page.wait_for_function("!document.getElementById('all').hidden")
        assert opened.page.is_visible("#tiles") and not opened.page.is_visible("#title")
    assert opened.faults == []


@pytest.fixture
def thousands(browsed: BrowsedDataset, tmp_path: Path) -> Path:
    """A page of 7000 pairs, which are always the same twelve."""
    shutil.copy(browsed.page, tmp_path)
    for name in ("site", "pictures"):
        (tmp_path / name).symlink_to(browsed.page.parent / name)
    begin, end = "droguekit.catalogue = ", ";\n"
    catalogue = json.loads(
        (browsed.page.parent / "data/catalogue.js").read_text().removeprefix(begin).removesuffix(end)
    )
    rows = catalogue["rows"]
    catalogue["rows"] = [{**rows[k % len(rows)], "frame": k, "sequence": k // 350} for k in range(7000)]
    shutil.copytree(browsed.page.parent / "data", tmp_path / "data")
    (tmp_path / "data/catalogue.js").write_text(begin + json.dumps(catalogue) + end)
    return tmp_path / "index.html"


def test_thousands_of_pairs_are_shown_in_parts(thousands: Path, open_page: OpenPage) -> None:
    page = open_page(thousands).page
    assert page.inner_text("#count") == "7000 of 7000 pairs"
    assert page.locator("#tiles img").count() == 60
    assert page.inner_text("#page-place") == "Page 1 of 117"
    page.click("#page-on")
    page.wait_for_function("document.getElementById('page-place').textContent === 'Page 2 of 117'")
    assert shown_frames(page) == list(range(60, 120))
    page.select_option("#filters [name=sequence]", "19")
    assert page.inner_text("#count") == "350 of 7000 pairs" and shown_frames(page)[0] == 19 * 350
    for number, shown in (("1.5", 1), ("1e9", 117), ("-3", 1), ("x", 1), ("117.2", 117)):
        page.goto(f"{thousands.as_uri()}#page={number}")
        page.wait_for_function(f"document.getElementById('page-place').textContent === 'Page {shown} of 117'")
        assert shown_frames(page)[0] == 60 * (shown - 1)


def test_a_held_key_goes_on_though_the_browser_stops_writing_the_address(
    thousands: Path, browser: Browser, chromium_path: str
) -> None:
    # Playwright switches off what keeps pages from writing the address more than 200 times in 10 s.
    guarded = browser.browser_type.launch(
        executable_path=chromium_path,
        args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"],
        ignore_default_args=["--disable-ipc-flooding-protection"],
    )
    try:
        page = guarded.new_page()
        page.goto(thousands.as_uri() + "#frame=0")
        page.evaluate("for (let k = 0; k < 230; k++) document.getElementById('next').click()")
        assert page.inner_text("#title").startswith("Frame 230,")
        assert page.evaluate("location.hash") != "#frame=230"
        # Nothing is read back from the address: the pair that is drawn is the one that was asked for.
        page.wait_for_selector("#left[aria-label^='Frame 230,']", state="attached")
    finally:
        guarded.close()


def test_while_a_key_is_held_the_address_waits(thousands: Path, open_page: OpenPage) -> None:
    page = open_page(thousands).page
    show(page, 5)
    for _ in range(4):
        page.keyboard.down("ArrowRight")
    assert page.inner_text("#title").startswith("Frame 9,") and page.evaluate("location.hash") == "#frame=6"
    page.keyboard.up("ArrowRight")
    assert page.evaluate("location.hash") == "#frame=9"


def broken(browsed: BrowsedDataset, folder: Path) -> Path:
    """A copy of the page, to be damaged."""
    shutil.copytree(browsed.page.parent, folder / "page")
    return folder / "page"


@pytest.mark.parametrize(("damage", "fault"), [("missing", "is missing"), ("empty", "holds no labels of it")])
def test_without_labels_a_pair_is_shown_alone(
    browsed: BrowsedDataset, open_page: OpenPage, tmp_path: Path, damage: str, fault: str
) -> None:
    copy = broken(browsed, tmp_path)
    (labels,) = (copy / "data").glob("000001-*.js")
    if damage == "missing":
        labels.unlink()
    else:
        labels.write_text("")
    page = open_page(copy / "index.html").page
    show(page, 0)
    assert page.locator("#left rect, #left path").count() > 0
    show(page, 1)
    assert f"data/{labels.name} {fault}" in page.inner_text("#fault")
    picture = page.get_attribute("#left image", "href")
    assert picture is not None and picture.startswith("pictures/000001-")
    assert page.locator("#left rect, #left path, #conditions td, #features td, #answers td").count() == 0
    assert page.is_disabled("#zoom")
    show(page, 2)
    assert not page.is_visible("#fault")


def test_a_missing_picture_is_named(browsed: BrowsedDataset, open_page: OpenPage, tmp_path: Path) -> None:
    copy = broken(browsed, tmp_path)
    (picture,) = (copy / "pictures").glob("000001-*-right.jpg")
    picture.unlink()
    page = open_page(copy / "index.html").page
    show(page, 1)
    page.wait_for_selector("#fault:not([hidden])")
    assert f"pictures/{picture.name} cannot be shown" in page.inner_text("#fault")
