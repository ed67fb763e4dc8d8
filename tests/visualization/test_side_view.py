"""The animation of a sequence: its pictures, its pace, and wrong orders."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from datasets_manifest.storage.reader import Dataset
from droguekit.cli.main import DONE, run
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


def test_mp4_has_all_pictures(docking: Path, tmp_path: Path) -> None:
    out = tmp_path / "docking.mp4"
    assert run(["preview", str(docking), "--animate", str(out), "--count", "5"]) == DONE
    movie = cv2.VideoCapture(str(out))
    found = 0
    while movie.read()[0]:
        found += 1
    movie.release()
    assert found == 5 and [path.name for path in tmp_path.iterdir()] == ["docking.mp4"]


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
def test_wrong_orders_are_named_on_one_line(
    docking: Path, options: list[str], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["preview", str(docking), *options]) != DONE
    told = capsys.readouterr().err
    assert fault in told and told.count("\n") == 1
