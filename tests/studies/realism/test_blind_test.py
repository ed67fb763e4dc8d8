"""Pictures are mixed without a trace of their kind, and judges are counted by the key."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import Recipe
from studies.realism.blind_test import HEIGHT_PX, KEY_FILE, WIDTH_PX, make_test, photograph_window, score
from tests.support.recipe_builder import build_recipe
from tests.support.small_datasets import TOY


def small_recipe() -> Recipe:
    return build_recipe(TOY, frames={"count": 2, "scenes": 2})


def test_windows_are_of_the_photograph_at_its_shape() -> None:
    rng = np.random.default_rng(1)
    # Columns count up, so that a window's own columns tell where and how large it is.
    photograph = np.zeros((900, 1600, 3), np.uint8)
    photograph[:] = (np.arange(1600) * 255 // 1599)[None, :, None]
    shares = []
    for _ in range(20):
        window = photograph_window(photograph, rng)
        assert window.shape == (HEIGHT_PX, WIDTH_PX, 3)
        assert (np.ptp(window.astype(int), axis=0) <= 1).all()
        shares.append((int(window[0, -1, 0]) - int(window[0, 0, 0])) / 255 * 1600 / 1200)
    # A window of full height is 1200 px wide; none is enlarged, which one of fewer than 640 px would be.
    assert 0.52 < min(shares) < 0.6 and 0.8 < max(shares) < 1.01


def test_the_pictures_are_mixed_and_the_key_tells_them_apart(tmp_path: Path) -> None:
    photograph = tmp_path / "sky.png"
    cv2.imwrite(str(photograph), np.full((500, 700, 3), (3, 5, 200), np.uint8))
    make_test(small_recipe(), [photograph], 2, tmp_path / "test", seed=4)
    key = json.loads((tmp_path / "test" / KEY_FILE).read_text())
    assert sorted(key) == ["01", "02", "03", "04"]
    for number, name in key.items():
        picture = cv2.imread(str(tmp_path / "test" / f"{number}.png"))
        assert picture is not None and picture.shape == (HEIGHT_PX, WIDTH_PX, 3)
        plain = (picture == (3, 5, 200)).all()
        assert plain == (name == "photograph sky.png")
    assert {name for name in key.values() if name.startswith("ours")} == {"ours toy frame 0", "ours toy frame 1"}
    with pytest.raises(FileExistsError):
        make_test(small_recipe(), [photograph], 1, tmp_path / "test", seed=4)


def test_judges_are_counted(tmp_path: Path) -> None:
    key, judge = tmp_path / KEY_FILE, tmp_path / "anna.csv"
    key.write_text(json.dumps({"01": "ours a", "02": "photograph b", "03": "ours c", "04": "ours d"}))
    judge.write_text("number,answer\n1,photograph\n2,photograph\n3,render\n4,render\n")
    assert score(key, [judge]).splitlines()[2] == "| anna | 1 of 3 (33 %) | 1 of 1 (100 %) |"
    for wrong in (
        "number,answer\n1,photograph\n2,photo\n3,render\n4,render\n",
        "number,answer\n1,render\nx,render\n",
        "1,render\n2,render\n3,render\n4,render\n",
    ):
        judge.write_text(wrong)
        with pytest.raises(ValueError, match=r"anna\.csv: must say photograph or render of each number from 01 to 04"):
            score(key, [judge])
