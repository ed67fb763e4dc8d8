"""The list of a dataset's pairs in a browser: filters that count right, orders, thousands of pairs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser

from datasets_manifest.types.estimates import PoseEstimate
from tests.support.browsed_dataset import HOSTILE, OTHER, PAIRS, BrowsedDataset, show, shown_frames

OpenPage = Callable[..., Any]


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


@pytest.mark.parametrize("method", HOSTILE)
def test_a_method_may_be_called_as_a_script_calls_its_own_things(
    browsed: BrowsedDataset, open_page: OpenPage, method: str
) -> None:
    opened = open_page(browsed.page)
    page = opened.page
    fixes = [i for i, estimate in browsed.estimates[method].items() if isinstance(estimate, PoseEstimate)]
    page.select_option("#filters [name=method]", method)
    page.select_option("#filters [name=result]", "fix")
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
        ({"method": OTHER, "result": "fix"}, fix),
        ({"result": "none"}, ~fix),
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
    page.fill("#page-number", "117")
    page.press("#page-number", "Enter")
    page.wait_for_function("document.getElementById('page-place').textContent === 'Page 117 of 117'")
    assert shown_frames(page) == list(range(6960, 7000)) and page.input_value("#page-number") == ""
    page.go_back()
    page.wait_for_function("document.getElementById('page-place').textContent === 'Page 2 of 117'")
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
