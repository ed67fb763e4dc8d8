"""The overlay video: its pictures, where its lines lie, and wrong orders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.estimates import Estimate, Feature, NoFix, PoseEstimate, write_estimates
from droguekit.cli.main import DONE, WRONG_INPUT, run
from droguekit.scoring.report.label_drawing import Rgb
from droguekit.visualization import overlay_video
from droguekit.visualization.overlay_video import ESTIMATE_RGB, TRUE_RGB, draw_overlay, write_overlay_video
from geometry.circles import disc_outline
from geometry.se3 import RigidTransform
from tests.support.recipe_builder import RIG_320_PX, between, recipe_text
from tests.support.small_datasets import rendered

RECIPE = recipe_text(
    name="flight",
    seed=5,
    rig=RIG_320_PX,
    frames={"count": 6, "scenes": 2, "empty_fraction": 0.5},
    distance=between(3.0, 6.0),
    render={"engine": "analytic"},
)
# The bar above, and the whole image beside which the close-up stands.
BAR_PX, WHOLE_PX = 64, (600, 800)
OFFSET_M = np.array([0.4, 0.0, 0.0])


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = rendered(RECIPE, tmp_path_factory.mktemp("flight") / "dataset")
    assert any(entry.empty for entry in Dataset(out).manifest.frames)
    return out


@pytest.fixture(scope="module")
def estimates(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, dataset = tmp_path_factory.mktemp("estimates") / "e.jsonl", Dataset(flight)
    found: list[Estimate] = []
    for index in dataset.frame_indices:
        pose = dataset.record(index).left_from_drogue
        if pose is None:
            # A false fix, as far away as a far one gets.
            pose = RigidTransform(np.eye(3), np.array([0.0, 300.0, 4.0]))
        moved = RigidTransform(pose.rotation, pose.translation_m + OFFSET_M)
        found.append(PoseEstimate(frame_index=index, method="own", left_from_drogue=moved))
        found.append(NoFix(frame_index=index, method="blind", reason="nothing seen in any of the images ✓"))
    write_estimates(path, found)
    return path


def movie_pictures(path: Path) -> list[np.ndarray]:
    """(H, W, 3) of every frame, blue, green, red."""
    movie, pictures = cv2.VideoCapture(str(path)), []
    while (read := movie.read())[0]:
        pictures.append(read[1])
    movie.release()
    return pictures


def distance_to(picture: np.ndarray, color: Rgb) -> np.ndarray:
    """(H, W) largest difference of a channel."""
    return np.asarray(np.abs(picture.astype(int) - color).max(axis=-1))


@pytest.mark.parametrize("method", ["own", "blind"])
def test_the_video_can_be_read(flight: Path, estimates: Path, tmp_path: Path, method: str) -> None:
    out = tmp_path / "new" / "overlay.mp4"
    options = ["--overlay", str(out), "--estimates", str(estimates), "--method", method]
    assert run(["preview", str(flight), *options]) == DONE
    pictures = movie_pictures(out)
    assert len(pictures) == 6
    # Even sizes, as codecs want them; the bar has text in all of them.
    assert {picture.shape for picture in pictures} == {(BAR_PX + WHOLE_PX[0], WHOLE_PX[1] + WHOLE_PX[0], 3)}
    assert min(picture[:BAR_PX].max() for picture in pictures) > 150
    assert [path.name for path in out.parent.iterdir()] == ["overlay.mp4"]


def test_outlines_lie_where_the_poses_project(flight: Path, estimates: Path) -> None:
    dataset = Dataset(flight)
    compared = 0
    for index in dataset.frame_indices:
        record = dataset.record(index)
        pose = record.left_from_drogue
        if pose is None:
            continue
        moved = RigidTransform(pose.rotation, pose.translation_m + OFFSET_M)
        estimate = PoseEstimate(frame_index=index, method="own", left_from_drogue=moved)
        picture = draw_overlay(record, dataset.images(index), record.frame.drogue, "own", estimate)
        whole = picture[BAR_PX:, : WHOLE_PX[1]]
        for shown, color in ((pose, TRUE_RGB), (moved, ESTIMATE_RGB)):
            outline = record.frame.rig.image(
                disc_outline(shown, (0, 0, 0), record.frame.drogue.rim_radius_m, 64), "left"
            )
            places = np.rint((outline + 0.5) * (WHOLE_PX[1] / 320) - 0.5).astype(int)
            inside = ((places >= 1) & (places < np.array(WHOLE_PX[::-1]) - 1)).all(axis=1)
            around = [distance_to(whole[y - 1 : y + 2, x - 1 : x + 2], color).min() for x, y in places[inside].tolist()]
            # Within a pixel of the projection there is a pixel of the line's own colour; smooth edges blend it, and
            # where both lines meet the one that is drawn later covers the other.
            assert np.mean(np.array(around) < 60) > 0.9
            compared += inside.sum()
    assert compared > 100


def test_a_long_name_leaves_room_for_the_numbers(flight: Path) -> None:
    dataset = Dataset(flight)
    index = next(entry.frame_index for entry in dataset.manifest.frames if not entry.empty)
    record, images = dataset.record(index), dataset.images(index)
    pose = record.left_from_drogue
    assert pose is not None

    def bar(name: str, off_m: float) -> np.ndarray:
        moved = RigidTransform(pose.rotation, pose.translation_m + np.array([0.0, 0.0, off_m]))
        fix = PoseEstimate(frame_index=index, method=name, left_from_drogue=moved)
        return draw_overlay(record, images, record.frame.drogue, name, fix)[:BAR_PX]

    long = "w" * 80
    # The last number of the line tells two errors apart, and the line ends before the picture does.
    assert (bar(long, 1e-3) != bar(long, 1.5)).any()
    nothing = draw_overlay(record, images, record.frame.drogue, "", None)[:BAR_PX]
    assert (bar(long, -1.5)[36:, -20:] == nothing[36:, -20:]).all()


def test_errors_have_three_digits(flight: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, told = Dataset(flight), list[str]()
    index = next(entry.frame_index for entry in dataset.manifest.frames if not entry.empty)
    record = dataset.record(index)
    pose = record.left_from_drogue
    assert pose is not None
    monkeypatch.setattr(overlay_video.cv2, "putText", lambda bar, text, *rest: told.append(text))
    moved = RigidTransform(pose.rotation, pose.translation_m + np.array([0.0, 0.0, -1.234e-6]))
    fix = PoseEstimate(frame_index=index, method="own", left_from_drogue=moved)
    draw_overlay(record, dataset.images(index), record.frame.drogue, "own", fix)
    assert any("own: 0.00123 mm off (x +0.00, y +0.00, z -0.00123)" in text for text in told)


def test_truth_alone_needs_no_estimates(flight: Path, tmp_path: Path) -> None:
    out = tmp_path / "truth.mp4"
    assert run(["preview", str(flight), "--overlay", str(out), "--count", "2"]) == DONE
    assert len(movie_pictures(out)) == 2


def test_empty_pairs_with_and_without_a_false_fix(flight: Path) -> None:
    dataset = Dataset(flight)
    index = next(entry.frame_index for entry in dataset.manifest.frames if entry.empty)
    record, images, drogue = dataset.record(index), dataset.images(index), dataset.manifest.recipe.drogue
    nothing = draw_overlay(record, images, drogue, "", None)
    assert distance_to(nothing[BAR_PX:], TRUE_RGB).min() > 60
    for place_m, is_seen in (([0.0, 3e5, 0.2], False), ([0.0, 1e200, 0.2], False), ([0.0, 0.0, 4.0], True)):
        fix = PoseEstimate(
            frame_index=index, method="own", left_from_drogue=RigidTransform(np.eye(3), np.array(place_m))
        )
        picture = draw_overlay(record, images, drogue, "own", fix)
        assert picture.shape == nothing.shape
        assert (distance_to(picture[BAR_PX:], ESTIMATE_RGB).min() < 60) == is_seen


def test_a_false_fix_of_a_dataset_with_one_drogue_is_drawn(flight: Path, tmp_path: Path) -> None:
    """Records of empty pairs do not name a drogue that the recipe names for all."""
    dataset = Dataset(flight)
    empty = next(entry.frame_index for entry in dataset.manifest.frames if entry.empty)
    assert dataset.record(empty).frame.drogue is None and dataset.record(empty).frame.sought is None
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 4.0]))
    fix = PoseEstimate(frame_index=empty, method="own", left_from_drogue=pose)
    write_overlay_video(dataset, tmp_path / "o.gif", 6, None, ("own", {empty: fix}))
    with Image.open(tmp_path / "o.gif") as movie:
        movie.seek(dataset.frame_indices.index(empty))
        picture = np.asarray(movie.convert("RGB"))
    # A film has 128 colours: the orange of a thin line comes near its own, and nothing else is orange.
    below = picture[round(picture.shape[0] * BAR_PX / (BAR_PX + WHOLE_PX[0])) + 2 :].astype(int)
    assert ((below[..., 0] - below[..., 2]) > 80).sum() > 50


def test_absurd_centres_are_left_out(flight: Path) -> None:
    dataset = Dataset(flight)
    index = next(entry.frame_index for entry in dataset.manifest.frames if not entry.empty)
    record, images = dataset.record(index), dataset.images(index)

    def found(*centers: tuple[float, float]) -> NoFix:
        features = [
            Feature(eye="left", index=k, center_px=center, cov_px2=((1, 0), (0, 1)), used=False)
            for k, center in enumerate(centers)
        ]
        return NoFix(frame_index=index, method="own", reason="too few", features=tuple(features))

    near = (40.0, 50.0)
    wanted = draw_overlay(record, images, record.frame.drogue, "own", found(near))
    got = draw_overlay(record, images, record.frame.drogue, "own", found(near, (1e12, 3.0), (5.0, -1e308)))
    np.testing.assert_array_equal(got, wanted)
    assert (got != draw_overlay(record, images, record.frame.drogue, "own", found())).any()


def test_a_near_drogue_is_made_smaller_without_noise(flight: Path) -> None:
    """Taken out of the picture pixel by pixel, a fine pattern would come out as it is."""
    dataset = Dataset(flight)
    index = next(entry.frame_index for entry in dataset.manifest.frames if entry.empty)
    record, images, drogue = dataset.record(index), dataset.images(index), dataset.manifest.recipe.drogue
    # At 0.2 m the drogue is larger than the image, and the close-up shows more than it has pixels for.
    pose = RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.2]))
    fix = PoseEstimate(frame_index=index, method="own", left_from_drogue=pose)
    pattern = np.zeros_like(images.left)
    pattern[::2, 1::2] = pattern[1::2, ::2] = np.iinfo(pattern.dtype).max
    images = replace(images, left=pattern, black_level_dn=0.0)
    close = draw_overlay(record, images, drogue, "own", fix)[BAR_PX:, WHOLE_PX[1] :]
    middle = close[280:320, 280:320]
    assert middle.std() < 40 and 60 < middle.mean() < 200


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        (["--overlay", "a.avi"], "--overlay: must end in .gif or .mp4, got a.avi"),
        (["--overlay", "a.mp4", "--out", "a.png"], "--out, --animate, --overlay: give one of them"),
        (["--overlay", "a.mp4", "--method", "own"], "--method: goes with --estimates"),
        (["--animate", "a.mp4", "--estimates", "FILE"], "--estimates, --method: go with --overlay"),
        (["--overlay", "a.mp4", "--estimates", "FILE"], "has several methods; name one of own, blind"),
        (["--overlay", "a.mp4", "--estimates", "FILE", "--method", "x"], "holds own, blind, got x"),
        (["--overlay", "a.mp4", "--sequence", "3"], "holds no pairs of sequence 3 to show"),
        (["--overlay", "a.mp4", "--count", "0"], "--count: must be from 1 to 2000"),
        (["--overlay", "s3://bucket/a.mp4"], "--overlay: must be a folder or file of this machine, got s3://"),
        (["--animate", "s3://bucket/a.gif"], "--animate: must be a folder or file of this machine, got s3://"),
        (["--overlay", "/proc/nowhere/a.mp4"], "/proc/nowhere/a.mp4: cannot be written"),
    ],
)
def test_wrong_orders_are_named_on_one_line(
    flight: Path, estimates: Path, options: list[str], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(estimates) if option == "FILE" else option for option in options]
    assert run(["preview", str(flight), *words]) == WRONG_INPUT
    told = capsys.readouterr().err
    assert fault in told and told.count("\n") == 1
