"""A dataset's page in a browser when its address is wrong, or a file of it is missing or damaged."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.browsed_dataset import BrowsedDataset, show

OpenPage = Callable[..., Any]


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
    assert page.locator("#left rect, #left path, #conditions td, #features td, #estimates td").count() == 0
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
