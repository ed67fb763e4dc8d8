"""`detect`, and `benchmark` on what it writes, through their own entry point."""

from __future__ import annotations

import contextlib
import io
import json
import uuid
from pathlib import Path
from typing import Any

import cv2
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from datasets_manifest.storage.layout import ANNOTATIONS_FOLDER
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import open_storage
from datasets_manifest.types.estimates import PoseEstimate, read_estimates
from droguekit.cli.main import DONE, FAULT, WRONG_INPUT, run
from droguekit.scoring.detection.detection_truth import read_detection_truth
from nav.detector.ring_detectors import ColorBlobDetector
from tests.support.recipe_builder import RIG_160_PX, between, recipe_text
from tests.support.small_datasets import rendered


@pytest.fixture(scope="module")
def detections(smoke_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("detect") / "boxes.json"
    assert run(["detect", str(smoke_dataset), "--detector", "color-blob", "--out", str(out)]) == DONE
    return out


def test_a_damaged_first_record_costs_that_pair_alone_where_each_pair_has_a_drogue_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe = recipe_text(
        name="two-drogues",
        rig=RIG_160_PX,
        frames={"count": 3, "scenes": 3, "empty_fraction": 0.0},
        target={"variants": [{"drogue": name} for name in ("red-8", "red-7")]},
        distance=between(2.0, 3.0),
        render={"engine": "analytic"},
    )
    dataset, out = rendered(recipe, tmp_path / "dataset"), tmp_path / "boxes.json"
    first, *others = Dataset(dataset).frame_indices
    (dataset / "frames" / f"{first:06d}" / "record.json").write_text("{")
    detecting = [["detect", str(dataset), "--out", str(out)], ["benchmark", str(dataset)]]
    for command in detecting:
        assert run([*command, "--detector", "color-blob"]) == FAULT
        told = capsys.readouterr().err
        assert f"1 pair has no result by a fault, first pair {first}: " in told and "record.json" in told
    assert {(box["image_id"] - 1) // 2 for box in json.loads(out.read_text())} == set(others)


def test_times_are_of_one_thread(smoke_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threads, search = set(), ColorBlobDetector.candidates

    def counted(detector: ColorBlobDetector, *arguments: Any) -> Any:
        threads.add(cv2.getNumThreads())
        return search(detector, *arguments)

    monkeypatch.setattr(ColorBlobDetector, "candidates", counted)
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        for command, file in (("detect", "--out"), ("benchmark", "--json")):
            options = ["--detector", "color-blob", file, str(tmp_path / f"{command}.json")]
            assert run([command, str(smoke_dataset), *options]) == DONE
            assert threads == {1}
            threads.clear()
    finally:
        cv2.setNumThreads(before)


def test_boxes_have_the_image_ids_of_the_annotations_and_agree_with_them_by_pycocotools(
    smoke_dataset: Path, detections: Path
) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(str(smoke_dataset / ANNOTATIONS_FOLDER / "all.json"))
        judge = COCOeval(truth, truth.loadRes(str(detections)), "bbox")
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    entries = json.loads(detections.read_text())
    assert {entry["image_id"] for entry in entries} <= set(truth.getImgIds())
    assert all(set(entry) == {"image_id", "category_id", "bbox", "score"} for entry in entries)
    # Six near drogues in clear daylight; the rim's circle is found to a pixel of at least 190.
    assert judge.stats[1] > 0.8


def test_the_truth_is_that_of_the_annotations(smoke_dataset: Path) -> None:
    annotations = json.loads((smoke_dataset / ANNOTATIONS_FOLDER / "all.json").read_text())["annotations"]
    boxes = {image.image_id: image.box_xywh for image in read_detection_truth(smoke_dataset).images if image.box_xywh}
    assert boxes == {entry["image_id"]: tuple(entry["bbox"]) for entry in annotations if entry["image_id"] in boxes}
    assert len(boxes) == 12


def test_benchmark_scores_a_file_like_the_detector_itself(
    smoke_dataset: Path, detections: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = ["--json", str(tmp_path / "scores.json"), "--html", str(tmp_path / "scores.html")]
    options = ["--detections", str(detections), "--detector", "color-blob", "--split", "all"]
    assert run(["benchmark", str(smoke_dataset), *options, *outputs]) == DONE
    told = capsys.readouterr().out
    assert "boxes" in told and "color-blob" in told
    scores = json.loads((tmp_path / "scores.json").read_text())
    from_file, live = scores["detectors"]["boxes"], scores["detectors"]["color-blob"]
    # Files hold boxes rounded to a thousandth of a pixel.
    assert from_file["overall"]["ap"] == pytest.approx(live["overall"]["ap"], abs=1e-3)
    assert live["times"]["pairs"] == 6 and from_file["times"] is None
    assert "<html" in (tmp_path / "scores.html").read_text()


def test_a_dataset_without_its_truth_gives_the_same_boxes(
    smoke_dataset: Path, detections: Path, tmp_path: Path
) -> None:
    blind = tmp_path / "blind"
    assert run(["export", str(smoke_dataset), "--format", "blind", "--out", str(blind)]) == DONE
    assert run(["detect", str(blind), "--detector", "color-blob", "--out", str(tmp_path / "boxes.json")]) == DONE
    assert json.loads((tmp_path / "boxes.json").read_text()) == json.loads(detections.read_text())
    scores = ["benchmark", str(blind), "--detections", str(tmp_path / "boxes.json")]
    assert run(scores) == WRONG_INPUT


@pytest.fixture
def imported(smoke_dataset: Path, tmp_path: Path) -> Path:
    """A dataset without truth, where somebody has drawn boxes into three of its images."""
    folder = tmp_path / "imported"
    assert run(["export", str(smoke_dataset), "--format", "blind", "--out", str(folder)]) == DONE
    table = json.loads((smoke_dataset / ANNOTATIONS_FOLDER / "all.json").read_text())
    drogue = next(each["id"] for each in table["categories"] if each["name"] == "drogue")
    table["annotations"] = [each for each in table["annotations"] if each["category_id"] == drogue][:3]
    (folder / ANNOTATIONS_FOLDER).mkdir()
    (folder / ANNOTATIONS_FOLDER / "all.json").write_text(json.dumps(table))
    return folder


def test_what_detect_finds_in_imported_images_can_be_scored_though_few_have_a_box(
    imported: Path, tmp_path: Path
) -> None:
    found, result = tmp_path / "boxes.json", tmp_path / "scores.json"
    assert run(["detect", str(imported), "--detector", "color-blob", "--out", str(found)]) == DONE
    assert len({entry["image_id"] for entry in json.loads(found.read_text())}) > 3
    assert run(["benchmark", str(imported), "--detections", str(found), "--json", str(result)]) == DONE
    scores = json.loads(result.read_text())
    assert (scores["dataset"]["images"], scores["detectors"]["boxes"]["overall"]["boxes"]) == (3, 3)


def test_a_dataset_elsewhere_is_scored_like_one_here(smoke_dataset: Path, detections: Path, tmp_path: Path) -> None:
    url = f"memory://{uuid.uuid4().hex}"
    for file in smoke_dataset.rglob("*"):
        if file.is_file():
            open_storage(url).write(file.relative_to(smoke_dataset).as_posix(), file.read_bytes())
    options = ["--detections", str(detections), "--detector", "color-blob", "--split", "all"]
    page = tmp_path / "scores.html"
    for place, out in ((str(smoke_dataset), tmp_path / "here.json"), (url, tmp_path / "there.json")):
        assert run(["benchmark", place, *options, "--json", str(out), "--html", str(page)]) == DONE
    here, there = (json.loads((tmp_path / f"{name}.json").read_text())["detectors"] for name in ("here", "there"))
    assert here["boxes"] == there["boxes"]
    assert here["color-blob"] | {"times": None} == there["color-blob"] | {"times": None}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (["--split", "best"], "--split: the dataset has no pairs"),
        (["--detector", "nobody"], "detector: must be one of"),
        (["--detector", "color-blob"], "two are named 'color-blob'"),
    ],
)
def test_wrong_input_is_said_before_a_detector_looks(
    smoke_dataset: Path, capsys: pytest.CaptureFixture[str], wrong: list[str], message: str
) -> None:
    assert run(["benchmark", str(smoke_dataset), "--detector", "color-blob", *wrong]) == WRONG_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line


def test_the_least_score_leaves_boxes_out(smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "boxes.json"
    options = ["--detector", "color-blob", "--least-score", "1", "--out", str(out)]
    assert run(["detect", str(smoke_dataset), *options]) == DONE
    assert json.loads(out.read_text()) == []


def test_navigate_looks_where_the_detector_says(smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "estimates.jsonl"
    options = ["--method", "joint", "--detector", "color-blob", "--out", str(out)]
    assert run(["navigate", str(smoke_dataset), *options]) == DONE
    assert any(isinstance(estimate, PoseEstimate) for estimate in read_estimates(out))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["detect", "{data}", "--detector", "nobody", "--out", "{out}"], "detector: must be one of"),
        (["detect", "{data}", "--detector", "none.onnx", "--out", "{out}"], "none.onnx"),
        (["detect", "{data}/none", "--out", "{out}"], "none"),
        (["detect", "{data}", "--least-score", "2", "--out", "{out}"], "--least-score: must be from 0 to 1, got 2"),
        (["navigate", "{data}", "--detector", "nobody", "--out", "{out}"], "detector: must be one of"),
        (["benchmark", "{data}"], "give either estimates, or detections"),
        (["benchmark", "{data}", "--estimates", "{out}", "--detector", "color-blob"], "give either estimates"),
        (["benchmark", "{data}", "--estimates", "{out}", "--split", "all"], "--split, --threshold: are for detections"),
        (["benchmark", "{data}", "--detections", "{out}"], "boxes.json: cannot be read"),
        (["benchmark", "{data}", "--detector", "color-blob", "--threshold", "nan"], "--threshold: must be from 0 to 1"),
        (["benchmark", "{data}", "--detections", "{there}", "--detections", "{there}"], "two are named"),
        (["benchmark", "{data}", "--detections", "{there}", "--split", "best"], "--split: the dataset has no pairs"),
    ],
)
def test_wrong_input_is_one_line_and_leaves_nothing(
    smoke_dataset: Path,
    detections: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    message: str,
) -> None:
    places = {"data": str(smoke_dataset), "out": str(tmp_path / "boxes.json"), "there": str(detections)}
    assert run([argument.format(**places) for argument in arguments]) == WRONG_INPUT
    told = capsys.readouterr().err.strip().splitlines()
    assert message in told[-1]
    assert list(tmp_path.iterdir()) == []
