from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from datasets_manifest.storage.blind import BlindDataset
from datasets_manifest.types.estimates import NoFix
from drogue_models.presets import PRESETS
from geometry.stereo import EYES
from nav.detector import detector_registry as registry
from nav.detector.detector_registry import (
    DEFAULT_DETECTOR,
    detector_factory,
    detector_names,
    network_file,
    open_detector,
    split_input_size,
)
from nav.detector.model_metadata import ModelMetadata
from nav.detector.ring_detectors import ColorBlobDetector
from nav.runner import navigate
from tests.support.detector_networks import write_red_squares
from tests.support.painted_pairs import make_pose, paint_pair

DROGUE = PRESETS["red-8"]


def test_the_default_is_among_the_names() -> None:
    assert DEFAULT_DETECTOR in detector_names()
    assert open_detector(DEFAULT_DETECTOR, DROGUE).name == DEFAULT_DETECTOR


@pytest.mark.parametrize("name", ["", "yolo", "mobile-xl", "weights.pt"])
def test_a_name_that_does_not_exist_lists_those_that_do(name: str) -> None:
    with pytest.raises(ValueError, match=r"detector: must be one of color-blob.* or a file \*\.onnx"):
        open_detector(name, DROGUE)


def test_networks_have_a_file() -> None:
    assert network_file("color-blob") is None
    assert str(network_file("other/mine.onnx")) == "other/mine.onnx"


def test_networks_of_the_package_are_known_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_red_squares(tmp_path, metadata=ModelMetadata(input_size_px=(320, 256)))
    assert network_file("squares") is None
    monkeypatch.setattr(registry, "_WEIGHTS", file.parent)
    assert detector_names() == ("color-blob", "peak-ring", "squares")
    assert network_file("squares") == file
    assert open_detector("squares", DROGUE).name == "squares"


def test_a_file_is_opened_once_and_called_by_its_name(tmp_path: Path) -> None:
    file = write_red_squares(tmp_path, metadata=ModelMetadata(input_size_px=(320, 256)))
    make = detector_factory(str(file))
    assert make(DROGUE).name == "squares"
    assert make(DROGUE) is make(PRESETS["white-8"])


def test_a_network_looks_at_the_size_behind_its_name(tmp_path: Path) -> None:
    file = write_red_squares(tmp_path, metadata=ModelMetadata(input_size_px=(320, 256)))
    detector = detector_factory(f"{file}@512x640")(DROGUE)
    assert detector.name == "squares@512x640" and detector.input_size_px == (640, 512)
    assert split_input_size(f"{file}@512x640") == (str(file), (640, 512))
    # Neither is a size.
    for name in ("mobile-s", "at@home/mine.onnx", "mine@512.onnx"):
        assert split_input_size(name) == (name, None)


@pytest.mark.parametrize(
    ("size", "fault"),
    [
        ("500x640", "detector: height and width must be multiples of 32 up to 4096, got "),
        ("32000x32000", "squares.onnx@32000x32000'"),
        ("0x0", "must be multiples of 32 up to 4096"),
        ("640", "detector: must be one of"),
    ],
)
def test_a_size_that_no_network_takes_is_refused(tmp_path: Path, size: str, fault: str) -> None:
    file = write_red_squares(tmp_path, metadata=ModelMetadata(input_size_px=(320, 256)))
    with pytest.raises(ValueError, match=re.escape(fault)):
        detector_factory(f"{file}@{size}")


def test_color_blob_has_the_detection_as_its_only_candidate() -> None:
    from geometry.pinhole import PinholeCamera
    from geometry.stereo import StereoRig

    rig = StereoRig(PinholeCamera(320, 240, 533.3, 533.3, 159.5, 119.5), 0.12)
    images = paint_pair(rig, DROGUE, make_pose(0.06, 0, 3.0, 5, 5, 10), np.random.default_rng(1))
    detector = ColorBlobDetector(DROGUE)
    found = detector.detect(images)
    candidates = detector.candidates(images, 0.1)
    for eye in EYES:
        detection = found.of(eye)
        assert detection is not None
        assert candidates[eye] == (detection,)
        assert detector.candidates(images, min(1.0, detection.score + 1e-6))[eye] == () or detection.score == 1


def test_navigation_uses_the_detector_that_is_named(smoke_dataset: Path, tmp_path: Path) -> None:
    dataset = BlindDataset(smoke_dataset)
    # A network whose threshold no score reaches.
    blind = str(write_red_squares(tmp_path, metadata=ModelMetadata(input_size_px=(640, 480), score_threshold=1.0)))
    estimates = list(navigate(dataset, ["joint"], detector=blind))
    assert estimates and all(isinstance(each, NoFix) and "no drogue detected" in each.reason for each in estimates)
    with pytest.raises(ValueError, match="detector: must be one of"):
        navigate(dataset, ["joint"], detector="nobody")


def test_naming_detectors_imports_nothing_heavy() -> None:
    code = (
        "import sys, nav.detector.detector_registry as registry; registry.detector_names();"
        "print([name for name in ('torch', 'onnxruntime', 'cv2', 'onnx') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
