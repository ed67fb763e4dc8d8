"""Photographs out of packages that are made here with dpkg-deb."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from studies.detector_weights.public_photographs import fetch_photographs, unpack_photographs

pytestmark = pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="needs dpkg-deb")


def write_noise(path: Path, height: int, width: int, seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    assert cv2.imwrite(str(path), pixels)


def build_package(root: Path) -> Path:
    control = root / "DEBIAN" / "control"
    control.parent.mkdir()
    control.write_text(
        "Package: pictures\nVersion: 1\nArchitecture: all\nMaintainer: a <a@b.c>\nDescription: pictures\n"
    )
    archive = root.with_suffix(".deb")
    subprocess.run(
        ["dpkg-deb", "--build", "--root-owner-group", "-Znone", root, archive], check=True, capture_output=True
    )
    return archive


def test_each_photograph_comes_once_and_reduced(tmp_path: Path) -> None:
    share = tmp_path / "package" / "usr" / "share"
    write_noise(share / "wallpapers" / "Lake" / "contents" / "images" / "500x400.png", 400, 500)
    write_noise(share / "wallpapers" / "Lake" / "contents" / "images" / "2000x500.png", 500, 2000)
    write_noise(share / "backgrounds" / "meadow.jpg", 420, 500)
    write_noise(share / "icons" / "button.png", 128, 128)
    write_noise(share / "backgrounds" / "banner.png", 200, 1000)
    drawing = np.full((450, 450, 4), 255, np.uint8)
    drawing[..., :3] = np.random.default_rng(1).integers(0, 256, (450, 450, 3))
    assert cv2.imwrite(str(share / "backgrounds" / "opaque.png"), drawing)
    drawing[:50, :50, 3] = 0
    assert cv2.imwrite(str(share / "backgrounds" / "drawing.png"), drawing)
    (share / "backgrounds" / "notes.txt").write_text("no picture" * 10_000)
    (share / "backgrounds" / "link.jpg").symlink_to("meadow.jpg")
    unpack_photographs(build_package(tmp_path / "package"), tmp_path / "out")
    shapes = {path.name: cv2.imread(str(path)).shape for path in (tmp_path / "out").iterdir()}
    assert shapes == {"Lake-contents.jpg": (400, 1600, 3), "meadow.jpg": (420, 500, 3), "opaque.jpg": (450, 450, 3)}


def test_only_photographs_of_the_examples_of_opencv_are_taken(tmp_path: Path) -> None:
    examples = tmp_path / "package" / "usr" / "share" / "doc" / "opencv-doc" / "examples"
    for name in ("data/building.jpg", "data/chessboard.png", "tutorials/building.jpg"):
        write_noise(examples / name, 500, 600, len(name))
    unpack_photographs(build_package(tmp_path / "package"), tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["building.jpg"]


def test_a_damaged_package_is_named(tmp_path: Path) -> None:
    archive = tmp_path / "broken.deb"
    archive.write_bytes(b"no archive")
    with pytest.raises(OSError, match=r"broken\.deb: dpkg-deb ended with"):
        unpack_photographs(archive, tmp_path / "out")


def test_a_package_that_debian_does_not_have_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no-such-pictures"):
        fetch_photographs(tmp_path / "out", ("no-such-pictures",))
    assert not (tmp_path / "out" / "packages.txt").exists()


def test_complete_photographs_are_not_fetched_again(tmp_path: Path) -> None:
    (tmp_path / "packages.txt").write_text("done\n")
    fetch_photographs(tmp_path, ("no-such-pictures",))
