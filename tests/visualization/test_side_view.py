"""The animation of a sequence: its pictures, its pace, its file formats, and wrong options."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from datasets_manifest.storage.reader import Dataset
from droguekit.cli.main import DONE, WRONG_INPUT, run
from droguekit.visualization.video_file import write_video
from labelgen.validation.dataset_checks import validate_dataset
from tests.support.small_datasets import docking_recipe, rendered


@pytest.fixture(scope="module")
def docking(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered(docking_recipe(sequences=2), tmp_path_factory.mktemp("docking") / "dataset")


def test_a_rendered_sequence_is_sound_and_says_what_is_in_view(docking: Path) -> None:
    assert validate_dataset(docking).faults == []
    for index in Dataset(docking).frame_indices:
        record = Dataset(docking).record(index)
        views = (record.views.left, record.views.right)
        assert record.sequence_id == index // 6
        assert record.conditions.markers_in_view == tuple(sum(m.in_image for m in view.markers) for view in views)
        assert record.conditions.hub_in_view == tuple(view.hub is not None and view.hub.in_image for view in views)


def test_gif_shows_a_sequence_in_its_own_time(docking: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "docking.gif"
    assert run(["preview", str(docking), "--animate", str(out), "--sequence", "1"]) == DONE
    with Image.open(out) as movie:
        assert movie.n_frames == 6
        pictures = []
        for frame in range(6):
            movie.seek(frame)
            assert movie.info["duration"] == 500
            pictures.append(np.asarray(movie.convert("RGB"), dtype=np.int16))
    # 960 px wide: on the left the flight from the side, on the right the camera; both change from picture to picture.
    for earlier, later in pairwise(pictures):
        changed = np.abs(later - earlier).max(axis=-1) > 60
        assert changed[:, :480].any() and changed[:, 480:].any()


def test_mp4_has_all_pictures_as_browsers_play_them(docking: Path, tmp_path: Path) -> None:
    out = tmp_path / "docking.mp4"
    assert run(["preview", str(docking), "--animate", str(out), "--count", "5"]) == DONE
    movie = cv2.VideoCapture(str(out))
    codec = int(movie.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little")
    size = (movie.get(cv2.CAP_PROP_FRAME_WIDTH), movie.get(cv2.CAP_PROP_FRAME_HEIGHT))
    pixel_format = int(movie.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)).to_bytes(4, "little")
    found = 0
    while movie.read()[0]:
        found += 1
    movie.release()
    assert (codec, pixel_format, size, found) == (b"h264", b"I420", (1280, 540), 5)
    # The index comes before the pictures, so that a page plays the file while it loads.
    content = out.read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")
    assert [path.name for path in tmp_path.iterdir()] == ["docking.mp4"]


def test_without_the_extra_one_line_names_it(
    docking: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    assert run(["preview", str(docking), "--animate", str(tmp_path / "a.mp4"), "--count", "2"]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert "pip install 'droguekit[video]'" in told and told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_odd_sides_of_pictures_become_even(tmp_path: Path) -> None:
    write_video(tmp_path / "odd.mp4", [np.full((33, 65, 3), 90, dtype=np.uint8)] * 3, 0.04)
    movie = cv2.VideoCapture(str(tmp_path / "odd.mp4"))
    there, picture = movie.read()
    movie.release()
    assert there and picture.shape == (34, 66, 3)
    # The codec keeps an even grey to within a rounding of its colour conversion.
    assert np.abs(picture.astype(int) - 90).max() <= 2


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--animate", "a.avi"], "--animate: must end in .gif or .mp4, got a.avi"),
        (["--animate", "a.gif", "--count", "0"], "--count: must be from 1 to 2000"),
        (["--animate", "a.gif", "--sequence", "7"], "holds no pairs of sequence 7 with drogue and tanker to animate"),
        (["--animate", "a.gif", "--out", "a.png"], "--out, --animate, --overlay: give one of them"),
        ([], "--out, --animate, --overlay: give one of them"),
        (["--out", "a.png", "--sequence", "0"], "--sequence: goes with --animate"),
        (["--animate", "/proc/nowhere/a.gif"], "/proc/nowhere/a.gif: cannot be written"),
    ],
)
def test_wrong_options_are_named_on_one_line(
    docking: Path, options: list[str], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["preview", str(docking), *options]) != DONE
    told = capsys.readouterr().err
    assert fault in told and told.count("\n") == 1
