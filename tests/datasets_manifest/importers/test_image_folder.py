from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_manifest.importers.image_files import read_image
from datasets_manifest.importers.image_folder import ImageFolder, find_pairs

WIDTH, HEIGHT = 32, 24


def picture(value: int, width: int = WIDTH) -> np.ndarray:
    """Red, green and blue differ, so that a swapped order shows."""
    return np.full((HEIGHT, width, 3), (value, 2 * value, 3 * value), np.uint8)


def save(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[:, :, ::-1] if rgb.ndim == 3 else rgb)


@pytest.mark.parametrize(
    "names",
    [
        "left/{}.png right/{}.png",
        "{}_left.png {}_right.png",
        "L_{}.bmp R_{}.bmp",
        "l_{}.tif r_{}.tif",
        "cam0/{}.png cam1/{}.png",
        "left{}.png right{}.png",
    ],
)
def test_two_files_a_pair(names: str, tmp_path: Path) -> None:
    for index in (9, 10, 2):
        for name, value in zip(names.split(), (index, index + 20), strict=True):
            save(tmp_path / name.format(index), picture(value))
    folder = ImageFolder(tmp_path, find_pairs(tmp_path, 10.0), WIDTH)
    pairs = list(folder)
    assert folder.count == 3 and folder.left_out == ()
    assert [int(pair.left[0, 0, 0]) for pair in pairs] == [2, 9, 10]
    for place, pair in enumerate(pairs):
        np.testing.assert_array_equal(pair.left, picture(int(pair.left[0, 0, 0])))
        np.testing.assert_array_equal(pair.right, picture(int(pair.left[0, 0, 0]) + 20))
        assert pair.time_s == pytest.approx(0.1 * place)


def test_names_with_a_line_break(tmp_path: Path) -> None:
    for side in ("left", "right"):
        save(tmp_path / f"a\nb_{side}.png", picture(7))
    assert ImageFolder(tmp_path, find_pairs(tmp_path, 10.0), WIDTH).count == 1


def test_views_side_by_side(tmp_path: Path) -> None:
    save(tmp_path / "0001.png", np.concatenate([picture(4), picture(5)], axis=1))
    (pair,) = ImageFolder(tmp_path, find_pairs(tmp_path), WIDTH)
    np.testing.assert_array_equal(pair.left, picture(4))
    np.testing.assert_array_equal(pair.right, picture(5))
    with pytest.raises(ValueError, match=r"0001\.png: must be two views of 20 px"):
        list(ImageFolder(tmp_path, find_pairs(tmp_path), 20))


def test_files_without_a_partner_are_told(tmp_path: Path) -> None:
    for name in ("left/1.png", "right/1.png", "left/2.png", "right/3.png"):
        save(tmp_path / name, picture(1))
    folder = ImageFolder(tmp_path, find_pairs(tmp_path), WIDTH)
    assert folder.count == 1
    assert [Path(line.split(":")[0]).name for line in folder.left_out] == ["2.png", "3.png"]


def test_depth_and_grey_stay(tmp_path: Path) -> None:
    deep = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 5
    save(tmp_path / "deep.png", deep)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png")[0], deep)


def test_folders_and_files_that_do_not_do_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        find_pairs(tmp_path / "none")
    with pytest.raises(ValueError, match="holds no images"):
        ImageFolder(tmp_path, find_pairs(tmp_path), WIDTH)
    save(tmp_path / "a.png", picture(1))
    whole = (tmp_path / "a.png").read_bytes()
    for damaged in (b"", whole[:40], b"text"):
        (tmp_path / "a.png").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"a\.png: is truncated"):
            read_image(tmp_path / "a.png")


def test_two_files_of_one_view_are_refused(tmp_path: Path) -> None:
    for name in ("left/1.png", "left/1.bmp", "right/1.png"):
        save(tmp_path / name, picture(1))
    with pytest.raises(ValueError, match="are the same view's"):
        ImageFolder(tmp_path, find_pairs(tmp_path), WIDTH)
