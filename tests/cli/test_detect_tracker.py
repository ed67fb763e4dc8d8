"""`detect --tracker` through its own entry point, on a sequence that is rendered for it."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from datasets_manifest.storage.layout import frame_folder, image_file
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.types.images import StereoImages
from droguekit.cli.main import DONE, WRONG_INPUT, run
from droguekit.scoring.detection.detection_truth import read_detection_truth
from droguekit.scoring.detection.detector_runner import DetectorRunner
from nav.detector.detector import StereoDetection
from nav.detector.ring_detectors import ColorBlobDetector
from nav.tracked_detection import TrackedDetector, tracked_detector_factory
from nav.tracking.tracker import tracker_names
from tests.support.recipe_builder import recipe_text

FRAMES = 8
# It finds all of these flat pictures to a percent; what is tested here is what comes after.
DETECTOR = ("--detector", "color-blob")
# Two sequences of four pairs, 10 s apart.
RECIPE = recipe_text(
    name="two-flights",
    family="docking",
    seed=3,
    rig={"preset": "rgb-ideal", "width_px": 640, "height_px": 480, "focal_px": 1067.0},
    frames={"count": 8, "scenes": 2},
    sequence={
        "frames_per_sequence": 4,
        "frame_rate_hz": 25,
        "hose": "full-size",
        "turbulence": ["light"],
        "receiver": {"manoeuvres": ["station"], "start_m": 6.0},
    },
    render={"engine": "analytic"},
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset of two sequences."""
    folder = tmp_path_factory.mktemp("flight")
    recipe, out = folder / "two-flights.toml", folder / "dataset"
    recipe.write_text(RECIPE)
    assert run(["render", str(recipe), "--workers", "0", "--out", str(out)]) == DONE
    return out


@pytest.mark.parametrize("tracker", ["bernoulli", "pose-predict"])
def test_results_are_those_of_a_detector(
    flight: Path, tracker: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "boxes.json"
    assert run(["detect", str(flight), *DETECTOR, "--tracker", tracker, "--out", str(out)]) == DONE
    assert f"color-blob+{tracker}: {2 * FRAMES} boxes in {2 * FRAMES} of {2 * FRAMES} images" in capsys.readouterr().out
    results = {entry["image_id"]: entry for entry in json.loads(out.read_text())}
    truth = {image.image_id: image.box_xywh for image in read_detection_truth(flight).images}
    assert results.keys() == truth.keys()
    for image_id, box in truth.items():
        assert box is not None
        # A percent of the box, and the whole pixels of the true visible box.
        assert results[image_id]["bbox"] == pytest.approx(box, abs=0.01 * max(box[2:]) + 1)


def test_without_a_tracker_the_same_images_are_answered(flight: Path, tmp_path: Path) -> None:
    plain, tracked = tmp_path / "plain.json", tmp_path / "tracked.json"
    assert run(["detect", str(flight), *DETECTOR, "--out", str(plain)]) == DONE
    assert run(["detect", str(flight), *DETECTOR, "--tracker", "flow", "--out", str(tracked)]) == DONE
    first, second = (json.loads(path.read_text()) for path in (plain, tracked))
    assert [entry["image_id"] for entry in first] == [entry["image_id"] for entry in second]
    assert first[0].keys() == second[0].keys()
    # The detector looks at the first pair of either sequence in both runs.
    starts = (0, 1, FRAMES, FRAMES + 1)  # entries of pairs 0 and 4, two an image pair
    assert [first[index]["bbox"] for index in starts] == [second[index]["bbox"] for index in starts]


@pytest.mark.parametrize("stage", ["read", "detect"])
def test_a_bad_pair_ends_the_sequence(
    flight: Path, stage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset, bad, seen = tmp_path / "dataset", 1, list[int]()
    shutil.copytree(flight, dataset)
    if stage == "read":
        (frame_folder(dataset, bad) / image_file("left")).write_bytes(b"")
    time_s = {round(record.time_s, 6): record.frame_index for record in Dataset(flight).records()}
    look, follow = ColorBlobDetector.detect, TrackedDetector.detect

    def noted(self: ColorBlobDetector, images: StereoImages) -> StereoDetection:
        seen.append(time_s[round(images.time_s, 6)])
        return look(self, images)

    def fails_once(self: TrackedDetector, images: StereoImages) -> StereoDetection:
        found = follow(self, images)
        if stage == "detect" and time_s[round(images.time_s, 6)] == bad:
            raise RuntimeError("half of the pair is done")
        return found

    monkeypatch.setattr(ColorBlobDetector, "detect", noted)
    monkeypatch.setattr(TrackedDetector, "detect", fails_once)
    runner = DetectorRunner(dataset, tracked_detector_factory(ColorBlobDetector, "flow"))
    list(runner.boxes(0.0, lambda: None))
    assert runner.faults.count == 1
    assert seen == [0, bad + 1, FRAMES // 2]


def test_help_names_every_tracker(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["detect", "--help"]) == DONE
    assert set(tracker_names()) <= set(re.findall(r"[\w-]+", capsys.readouterr().out))


def test_a_tracker_that_does_not_exist_is_said_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "boxes.json"
    assert run(["detect", str(tmp_path), "--tracker", "csrt", "--out", str(out)]) == WRONG_INPUT
    assert "tracker: must be one of bernoulli, flow, mil, pose-predict, got 'csrt'" in capsys.readouterr().err
    assert not out.exists()
