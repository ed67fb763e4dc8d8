"""Sheets of left images: what is on them, and which are refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from datasets_manifest.types.records import PairRecord
from droguekit.cli.main import DONE, WRONG_INPUT, run
from droguekit.visualization import contact_sheet
from tests.support.recipe_builder import RIG_160_PX, between, recipe_text
from tests.support.small_datasets import rendered

TILE_PX = 64
# Of an image of 160 x 120 pixels.
HEIGHT_PX = 48
CAPTION_PX, GAP_PX = 22, 4


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine pairs: two families have four, and one has one."""
    text = recipe_text(
        name="sheet",
        seed=1,
        rig=RIG_160_PX,
        frames={"count": 9, "scenes": 9},
        distance=between(3.0, 12.0),
        families=[{"name": "clear", "weight": 4}, {"name": "hazy", "weight": 4}, {"name": "odd"}],
        render={"engine": "analytic"},
    )
    return rendered(text, tmp_path_factory.mktemp("sheet") / "dataset")


def size_of(sheet: Path) -> tuple[int, int]:
    image = cv2.imread(str(sheet))
    assert image is not None
    return image.shape[0], image.shape[1]


def preview(dataset: Path, out: Path, *options: str) -> int:
    return run(["preview", str(dataset), "--out", str(out), "--tile-width", str(TILE_PX), *options])


@pytest.mark.parametrize(
    ("options", "shown", "rows", "columns", "length"),
    [
        # Rows are as long as the longest family, and no column is empty.
        (["--count", "400", "--columns", "4"], 9, 1, 3, 4),
        # A row for each family unless columns are asked for.
        (["--count", "6"], 5, 3, 1, 2),
        (["--count", "6", "--columns", "2"], 5, 2, 2, 2),
        (["--count", "3", "--columns", "1"], 3, 3, 1, 1),
    ],
)
def test_rows_of_families_are_full(
    options: list[str],
    shown: int,
    rows: int,
    columns: int,
    length: int,
    dataset: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "sheet.png"
    assert preview(dataset, out, "--by-family", *options) == DONE
    assert f"{shown} of 9 pairs" in capsys.readouterr().out
    width_px = length * (TILE_PX + GAP_PX) - GAP_PX
    assert size_of(out) == (
        rows * (CAPTION_PX + HEIGHT_PX + GAP_PX) + GAP_PX,
        columns * (width_px + GAP_PX) + GAP_PX,
    )


def test_tiles_of_a_family_are_spread_over_its_pairs(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, list[int]] = {}

    def draw_plain(images: StereoImages, record: PairRecord, width_px: int) -> np.ndarray:
        drawn.setdefault(record.conditions.family, []).append(record.frame_index)
        return np.zeros((HEIGHT_PX, width_px, 3), np.uint8)

    monkeypatch.setattr(contact_sheet, "_plain_tile", draw_plain)
    assert preview(dataset, tmp_path / "sheet.png", "--by-family", "--count", "6") == DONE
    source = Dataset(dataset)
    for family, shown in drawn.items():
        own = [index for index in source.frame_indices if source.record(index).conditions.family == family]
        assert shown == [own[0], own[-1]][: len(own)]


def test_fewer_pairs_than_families_are_refused(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert preview(dataset, tmp_path / "sheet.png", "--by-family", "--count", "2") == WRONG_INPUT
    assert "--count: must be at least 3, a pair for each family, got 2" in capsys.readouterr().err


def test_tiles_are_read_from_left_to_right(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    assert preview(dataset, out, "--count", "3", "--columns", "2") == DONE
    image = cv2.imread(str(out))
    assert image is not None
    assert image.shape[:2] == (2 * (CAPTION_PX + HEIGHT_PX + GAP_PX) + GAP_PX, 2 * (TILE_PX + GAP_PX) + GAP_PX)
    place = CAPTION_PX + HEIGHT_PX + 2 * GAP_PX, TILE_PX + 2 * GAP_PX
    assert np.ptp(image[place[0] :, : place[1]]) > 100
    assert np.ptp(image[place[0] :, place[1] :]) == 0


def test_sheets_that_are_too_large_are_refused_before_they_are_drawn(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn: list[int] = []
    draw = contact_sheet._draw_tile
    monkeypatch.setattr(contact_sheet, "_draw_tile", lambda *given: drawn.append(1) or draw(*given))
    monkeypatch.setattr(contact_sheet, "_MOST_JPEG_SIDE_PX", 600)
    assert preview(dataset, tmp_path / "long.jpg", "--columns", "1") == WRONG_INPUT
    assert (
        "--out: the sheet would be 72 x 670 px, and a side of a .jpg file has at most 600; write a .png, or change "
        "--columns" in capsys.readouterr().err
    )
    assert len(drawn) == 1
    assert preview(dataset, tmp_path / "long.png", "--columns", "1") == DONE
    monkeypatch.setattr(contact_sheet, "_MOST_PX", 40_000)
    assert preview(dataset, tmp_path / "more.png", "--columns", "1") == WRONG_INPUT
    assert "and 40000 px in all are the most; lower --count or --tile-width" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long.png"]


def test_the_limit_of_jpeg_is_the_encoders() -> None:
    for side_px, is_held in ((contact_sheet._MOST_JPEG_SIDE_PX, True), (contact_sheet._MOST_JPEG_SIDE_PX + 1, False)):
        try:
            is_done, _ = cv2.imencode(".jpg", np.zeros((side_px, 1, 3), dtype=np.uint8))
        except cv2.error:
            is_done = False
        assert is_done == is_held
