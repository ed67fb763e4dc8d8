"""Start and scores of a training of shipped weights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from droguekit.api.recipe_rendering import load_recipe, render_dataset
from nav.detector.detector_registry import network_file
from studies.detector_weights import __main__ as study
from studies.detector_weights.__main__ import Start, score_lines, write_start


def test_a_start_that_the_history_lacks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(study.STARTS, "l", Start("0123456", "0" * 64))
    with pytest.raises(OSError, match=r"0123456:nav/detector/weights/mobile-l\.onnx.*--unshallow"):
        write_start("l", tmp_path / "start.onnx")
    assert not (tmp_path / "start.onnx").exists()


def test_a_start_with_another_hash_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(study.STARTS, "s", Start("HEAD", "0" * 64))
    with pytest.raises(OSError, match="is not the file with sha256 0000"):
        write_start("s", tmp_path / "start.onnx")


def test_detectors_stand_side_by_side(tmp_path: Path) -> None:
    small = {"preset": "rgb-ideal", "encoding": "gamma", "width_px": 320, "height_px": 240, "focal_px": 533.3}
    recipe = load_recipe("detector-small", frames={"count": 3, "scenes": 3}, rig=small, render={"engine": "analytic"})
    render_dataset(recipe, tmp_path / "test", workers=0)
    (tmp_path / "test-photographs").mkdir()
    grey = np.full((480, 640, 3), 128, dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "test-photographs" / "grey.png"), grey)
    network = network_file("mobile-s")
    assert network is not None
    lines = list(score_lines(tmp_path, {"former": network, "new": network}))
    heads = ("drogue", "images", "drogues", "former: AP50, recall", "false boxes", "new: AP50, recall", "false boxes")
    assert lines[0] == f"| {' | '.join(heads)} |"
    assert lines[-3].startswith("| all | 6 |")
    # The same network scores the same.
    cells = lines[-3].strip("| ").split(" | ")[3:]
    assert cells[:2] == cells[2:]
    assert lines[-1] == "new: boxes in 0 of 1 photographs without a drogue"
