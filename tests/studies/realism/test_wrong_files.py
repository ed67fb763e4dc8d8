"""A file that is missing, damaged or of another kind ends a part with one line that names it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from studies.realism.__main__ import main
from studies.realism.blind_test import KEY_FILE
from studies.realism.scene_variety import HEIGHT_PX, WIDTH_PX, clusters, look, variety_table
from tests.support.recipe_builder import build_recipe
from tests.support.small_datasets import TOY

RIGHT_KEY = json.dumps({"01": "ours a", "02": "photograph b"})


def said(arguments: list[str], capfd: pytest.CaptureFixture[str]) -> str:
    """The one line that a part prints of wrong input; decoders would write past `sys.stderr`."""
    assert main(arguments) == 2
    out, err = capfd.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    return line


@pytest.fixture
def wrong_pictures(tmp_path: Path) -> dict[str, str]:
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8)
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    (tmp_path / "good.jpg").write_bytes(data)
    (tmp_path / "half.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "notes.txt").write_text("x")
    return {"none.jpg": "No such file", "half.jpg": "damaged", "notes.txt": "damaged, or not an image"}


@pytest.mark.parametrize("part", [["clouds"], ["blind-test", "demo"]])
def test_a_wrong_photograph_is_named_before_anything_is_drawn(
    part: list[str], tmp_path: Path, wrong_pictures: dict[str, str], capfd: pytest.CaptureFixture[str]
) -> None:
    for name, fault in wrong_pictures.items():
        out = ["--out", str(tmp_path / "test")] if part[0] == "blind-test" else []
        line = said([*part, *out, "--photographs", str(tmp_path / "good.jpg"), str(tmp_path / name)], capfd)
        assert f"{tmp_path / name}: " in line and fault in line
        assert not (tmp_path / "test").exists()


@pytest.mark.parametrize(("option", "value"), [("--count", "0"), ("--seed", "-1")])
def test_numbers_out_of_range_are_named(
    option: str, value: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    given = ["blind-test", "demo", option, value, "--photographs", "a.png", "--out", str(tmp_path / "test")]
    assert f"{option}: must" in said(given, capfd)


def test_a_picture_without_a_part_of_4_to_3_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "line.png"), np.zeros((1, 9, 3), np.uint8))
    given = ["blind-test", "demo", "--photographs", str(tmp_path / "line.png"), "--out", str(tmp_path / "test")]
    assert "line.png: must be at least 4 px wide and high, got (9, 1)" in said(given, capfd)


@pytest.mark.parametrize("key", [None, "{", "[1, 2]", "{}", '{"01": 3}', '{"01": "ours a"}', '{"01": "other"}', "\0"])
def test_a_wrong_key_is_named(key: str | None, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    if key is not None:
        (tmp_path / KEY_FILE).write_text(key)
    line = said(["blind-score", str(tmp_path / KEY_FILE), "anna.csv"], capfd)
    assert f"{tmp_path / KEY_FILE}: " in line
    assert ("give the key.json" in line) == (key is not None)


@pytest.mark.parametrize("answers", [None, b"number,answer\n\xff\xfe,render\n", b"number,answer\n1,render\n", b""])
def test_wrong_answers_are_named(answers: bytes | None, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / KEY_FILE).write_text(RIGHT_KEY)
    if answers is not None:
        (tmp_path / "anna.csv").write_bytes(answers)
    line = said(["blind-score", str(tmp_path / KEY_FILE), str(tmp_path / "anna.csv")], capfd)
    assert "anna.csv: " in line


def test_answers_of_a_spreadsheet_have_a_byte_order_mark(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / KEY_FILE).write_text(RIGHT_KEY)
    (tmp_path / "anna.csv").write_bytes(b"\xef\xbb\xbfnumber,answer\r\n1,render\r\n2,photograph\r\n")
    assert main(["blind-score", str(tmp_path / KEY_FILE), str(tmp_path / "anna.csv")]) == 0
    assert "| anna | 0 of 1 (0 %) | 1 of 1 (100 %) |" in capfd.readouterr().out


@pytest.mark.parametrize("part", [["variety", "demo"], ["blind-test"]])
def test_a_recipe_that_is_missing_is_named(part: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rest = ["--photographs", "a.png", "--out", str(tmp_path / "test")] if part[0] == "blind-test" else []
    assert "none.toml: cannot be read" in said([*part, "none.toml", *rest], capfd)


def test_families_without_a_scene_are_named_and_one_scene_is_one_cluster() -> None:
    with pytest.raises(ValueError, match="--family: recipe toy has no scene of baskets"):
        variety_table(build_recipe(TOY, frames={"count": 1, "scenes": 1}), ["baskets"])
    assert clusters([look(np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.float32))]).tolist() == [1]
