"""The other projects' detectors without their environment: corpus, length of the training, and wrong input."""

from __future__ import annotations

import fcntl
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from datasets_manifest.recipe.recipe import RecipeSource, load_recipe, parse_recipe
from datasets_manifest.storage.reader import Dataset
from droguekit.batch.progress import PlainProgress
from droguekit.batch.render_dataset import render_dataset
from droguekit.cli.main import DONE, run
from droguekit.scoring.detection.detection_scores import DetectorOutput, score_detections
from droguekit.scoring.detection.detection_truth import read_detection_truth
from droguekit.scoring.detection.detector_runner import LEAST_SCORE, DetectorRunner
from geometry.stereo import EYES
from nav.detector.input_image import input_image
from nav.detector.onnx_detector import OnnxDetector
from nav.training.training_settings import build_settings
from studies.detector_comparison.__main__ import (
    ComparisonOptions,
    compare_peers,
    comparison_lines,
)
from studies.detector_comparison.ablation import (
    CHANGES,
    ONE_VIEW,
    AblationOptions,
    SingleViewDetector,
    ablate,
    ablation_lines,
    measured_networks,
    settings_text,
)
from studies.detector_comparison.accuracy_plot import pareto_front
from studies.detector_comparison.options import input_size_px
from studies.detector_comparison.peer_corpus import (
    check_corpus,
    export_corpus,
    training_image_count,
    training_length,
)
from studies.detector_comparison.peer_environment import run_script
from studies.detector_comparison.peers import PEERS
from studies.detector_comparison.ultralytics_script import train
from tests.support.detector_networks import write_maps_network, write_rows_network


@pytest.fixture(scope="module")
def screen_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six small pairs as a screen wants them, two in each split."""
    text = load_recipe("smoke").text
    changed = text.replace('preset = "rgb-ideal"', 'preset = "rgb-ideal"\nencoding = "gamma"')
    changed = changed.replace("scenes = 2", "scenes = 3\nempty_fraction = 0.2").replace("train = 0.5", "train = 0.34")
    changed = changed.replace("val = 0.0", "val = 0.33").replace("test = 0.5", "test = 0.33")
    changed = changed.replace("[render]", '[render]\nengine = "analytic"').replace("seed = 1", "seed = 8")
    recipe = parse_recipe(changed)
    out = tmp_path_factory.mktemp("screen") / "dataset"
    with (out.parent / "log").open("w") as told:
        render_dataset(RecipeSource(recipe, changed), out, range(6), 0, PlainProgress(told))
    return out


TWO_PEERS = ("yolov8s", "yolov8n")


def order(corpus: Path, folder: Path, **changes: object) -> ComparisonOptions:
    values: dict[str, object] = {
        "corpus": corpus,
        "test": corpus,
        "ours": (),
        "image_passes": 100,
        "size_px": (64, 64),
        "batch": 4,
        "threads": 1,
        "rounds": 2,
        "device": "cpu",
        "seed": 0,
        "environment": folder / "environment",
        "peers": TWO_PEERS,
    }
    return ComparisonOptions(**{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("size_px", [(160, 96), (320, 256)])
def test_the_exported_corpus_has_one_class_and_our_networks_input(
    screen_dataset: Path, tmp_path: Path, size_px: tuple[int, int]
) -> None:
    data = export_corpus(screen_dataset, tmp_path / "corpus", size_px)
    assert data.read_text().endswith("test: images/test\nnames:\n  0: drogue\n")
    annotations = json.loads((screen_dataset / "annotations" / "all.json").read_text())
    expected = {annotation["image_id"]: annotation["bbox"] for annotation in annotations["annotations"]}
    source = Dataset(screen_dataset)
    camera = source.manifest.recipe.rig.camera
    # 320 x 240 px fit into 160 x 96 as 128 x 96, and stay as they are in 320 x 256.
    scale, offset = (0.4, (16, 0)) if size_px == (160, 96) else (1.0, (0, 8))
    assert (camera.width_px, camera.height_px) == (320, 240)
    labels = sorted((data.parent / "labels").rglob("*.txt"))
    assert len(labels) == 12 and training_image_count(screen_dataset) == 4
    for label in labels:
        frame, eye = label.stem.split("_")
        rows = [[float(number) for number in row.split()] for row in label.read_text().splitlines()]
        box = expected.get(2 * int(frame) + (eye == "right") + 1)
        assert len(rows) == (box is not None)
        if box is not None:
            number, x, y, width, height = rows[0]
            found = [(x - width / 2) * size_px[0], (y - height / 2) * size_px[1], width * size_px[0]]
            want = [box[0] * scale + offset[0], box[1] * scale + offset[1], box[2] * scale]
            # Divided by the picture's size and multiplied by it again, in double precision.
            assert number == 0 and found == pytest.approx(want, abs=1e-9)
        picture = data.parent / "images" / label.relative_to(data.parent / "labels").with_suffix(".png")
        seen, _ = input_image(source.images(int(frame)), "right" if eye == "right" else "left", size_px)
        np.testing.assert_array_equal(cv2.imread(str(picture))[..., ::-1], seen)
    # What is there already stays.
    label.write_text("")
    export_corpus(screen_dataset, tmp_path / "corpus", size_px)
    assert label.read_text() == ""


def test_a_corpus_that_lacks_a_split_is_refused(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="needs pairs in the splits train, val, test, got"):
        compare_peers(order(smoke_dataset, tmp_path), tmp_path / "out", print)
    assert list(tmp_path.iterdir()) == []


def test_a_corpus_without_a_test_split_is_scored_on_another_dataset(
    screen_dataset: Path, smoke_dataset: Path, tmp_path: Path
) -> None:
    # The one lacks pairs to choose by, so it serves to be scored on but not to train on.
    compared = order(screen_dataset, tmp_path, test=smoke_dataset)
    check_corpus(compared.corpus, compared.test)
    with pytest.raises(ValueError, match="needs pairs in the splits train, val, got"):
        compare_peers(order(smoke_dataset, tmp_path, test=screen_dataset), tmp_path / "out", print)
    assert list(tmp_path.iterdir()) == []


def test_a_test_dataset_of_training_scenes_is_refused(screen_dataset: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(screen_dataset, again)
    with pytest.raises(ValueError, match=r"again: has scenes of .*, for both have the seed 8; render one with"):
        compare_peers(order(screen_dataset, tmp_path, test=again), tmp_path / "out", print)
    assert list(tmp_path.iterdir()) == [again]


def test_a_folder_in_which_another_comparison_runs_is_refused(screen_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with (out / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="out: another comparison is running in it; wait for its end"):
            compare_peers(order(screen_dataset, tmp_path), out, print)
    assert [file.name for file in out.iterdir()] == [".lock"]


@pytest.mark.parametrize(
    ("passes", "images", "expected"),
    [
        (1, 1000, (1, 0.001, 1)),
        (300, 1000, (1, 0.3, 300)),
        (1000, 1000, (1, 1.0, 1000)),
        (1400, 1000, (1, 1.0, 1000)),
        (1600, 1000, (2, 1.0, 2000)),
        (40_000, 1_680, (24, 1.0, 40_320)),
    ],
)
def test_passes_are_rounded_to_whole_epochs_of_all_images(
    passes: int, images: int, expected: tuple[int, float, int]
) -> None:
    assert training_length(passes, images) == expected


def test_a_training_without_images_is_refused() -> None:
    with pytest.raises(ValueError, match="has no images to train on"):
        training_length(100, 0)


SCRIPTS = sorted({peer.script for peer in PEERS.values()})


def test_a_step_of_ultralytics_takes_as_many_images_as_the_task_says(tmp_path: Path) -> None:
    asked: list[dict[str, Any]] = []
    yolo = SimpleNamespace(train=lambda **settings: asked.append(settings))
    task = {"config": "c", "data": "d", "folder": str(tmp_path), "epochs": 2, "fraction": 1.0, "size_px": [64, 64]}
    train(lambda config: yolo, {**task, "batch": 4, "step_images": 8, "threads": 1, "device": "cpu", "seed": 0})
    assert (asked[0]["batch"], asked[0]["nbs"]) == (4, 8)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_an_error_of_a_script_names_the_log_and_its_last_line(script: Path, tmp_path: Path) -> None:
    task = {"do": "export", "config": "d-fine-n", "weights": None, "size_px": [64, 64]}
    # Our own interpreter has none of the projects.
    with pytest.raises(OSError, match=rf"export\.log: {script.stem} ended with status 1: ModuleNotFoundError"):
        run_script(Path(sys.executable), script, task, tmp_path / "new" / "export.log", {})


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_the_scripts_need_nothing_of_ours(script: Path) -> None:
    # In isolated mode with another folder as home, as in the peers' environment.
    task = '{"do": "export", "config": "d-fine-n", "weights": null, "size_px": [64, 64]}'
    ended = subprocess.run([sys.executable, "-I", str(script)], input=task, capture_output=True, text=True, check=False)
    first = "torchvision" if script.stem == "libreyolo_script" else "ultralytics"
    assert f"No module named '{first}'" in ended.stderr


def test_every_peer_gets_its_own_task_and_pictures_of_its_input(
    screen_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, dict[str, Any]]] = []

    def run_nothing(python: Path, script: Path, task: dict[str, Any], log: Path, variables: dict[str, str]) -> None:
        asked.append((script.stem, task))
        if task["do"] == "export":
            raise OSError("exported")

    monkeypatch.setattr("studies.detector_comparison.__main__.run_script", run_nothing)
    monkeypatch.setattr("studies.detector_comparison.__main__.peer_python", lambda folder, say: Path("python"))
    scripts = {"yolov8n": "ultralytics_script", "d-fine-n": "libreyolo_script", "rtmdet-tiny": "libreyolo_script"}
    for name, script in scripts.items():
        asked.clear()
        options = order(screen_dataset, tmp_path, image_passes=10, size_px=(256, 192), peers=(name,))
        with pytest.raises(OSError, match="exported"):
            compare_peers(options, tmp_path / name, lambda line: None)
        assert [stem for stem, _ in asked] == [script] * 2
        training, export = (task for _, task in asked)
        size_px = (256, 256) if name == "d-fine-n" else (256, 192)
        assert training["config"] == export["config"] == PEERS[name].config
        assert training["size_px"] == export["size_px"] == size_px
        # Of four images to train on ten passes are two epochs; Python rounds halves to even numbers.
        expected = {"do": "train", "epochs": 2, "fraction": 1.0, "batch": 4, "threads": 1, "device": "cpu", "seed": 0}
        # The default of ultralytics, whatever the batch; libreyolo takes a step for each batch.
        expected["step_images"] = 64
        assert {key: training[key] for key in expected} == expected
        pictures = list((Path(training["data"]).parent / "images" / "train").iterdir())
        assert len(pictures) == 4 and cv2.imread(str(pictures[0])).shape == (size_px[1], size_px[0], 3)
        assert export["weights"] == str(Path(training["folder"]) / "train" / "weights" / "best.pt")
        # What is trained already stays when the run goes on.
        asked.clear()
        with pytest.raises(OSError, match="exported"):
            compare_peers(options, tmp_path / name, lambda line: None)
        assert [task["do"] for _, task in asked] == ["export"]


def test_a_folder_of_another_comparison_is_refused(screen_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "settings.json").write_text(json.dumps({"image_passes": "7"}))
    with pytest.raises(
        ValueError,
        match="holds a comparison with another batch, corpus, image_passes, seed, size_px, step_images, test",
    ):
        compare_peers(order(screen_dataset, tmp_path), out, print)
    (out / "settings.json").write_text("[1]")
    with pytest.raises(ValueError, match=r"settings\.json: must hold the settings of a comparison, got list"):
        compare_peers(order(screen_dataset, tmp_path), out, print)
    (out / "settings.json").write_text("{")
    with pytest.raises(ValueError, match=r"settings\.json: is not JSON"):
        compare_peers(order(screen_dataset, tmp_path), out, print)


@pytest.mark.parametrize(
    ("name", "message"), [("ours.onnx", "cannot be read"), ("yolov8s.onnx", "another detector is named 'yolov8s'")]
)
def test_errors_of_our_detectors_are_found_before_anything_is_trained(
    screen_dataset: Path, tmp_path: Path, name: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        compare_peers(order(screen_dataset, tmp_path, ours=(tmp_path / name,)), tmp_path / "out", print)
    assert list(tmp_path.iterdir()) == []


def test_a_network_of_ours_that_cannot_be_counted_is_refused_before_anything_is_trained(
    screen_dataset: Path, tmp_path: Path
) -> None:
    odd = write_maps_network(tmp_path / "odd.onnx", is_countable=False)
    with pytest.raises(ValueError, match="its shape cannot be inferred"):
        compare_peers(order(screen_dataset, tmp_path, ours=(odd,)), tmp_path / "out", print)
    assert list(tmp_path.iterdir()) == [odd]


@pytest.mark.slow
def test_trained_peers_are_timed_and_scored_by_the_benchmark(screen_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    truth = {image.image_id: image for image in read_detection_truth(screen_dataset).images if image.split == "test"}
    some = next(image for image in truth.values() if image.box_xywh is not None and image.eye == "left")
    assert some.box_xywh is not None
    x, y, width, height = (0.2 * number for number in some.box_xywh)
    rows = np.zeros((2, 5, 2), np.float32)
    # 320 x 240 px fit into 64 x 64 as 64 x 48, from row 8 on. The one network finds the drogue in one image.
    rows[0, :, 0] = [x + width / 2, y + 8 + height / 2, width, height, 0.8]
    write_rows_network(out / "yolov8s.onnx", rows)
    write_rows_network(out / "yolov8n.onnx", np.zeros_like(rows))
    told: list[str] = []
    found = compare_peers(order(screen_dataset, tmp_path), out, told.append)
    assert not any("training" in line or "installing" in line for line in told)
    files = [word for name in TWO_PEERS for word in ("--detections", str(out / "detections" / f"{name}.json"))]
    words = ["benchmark", str(screen_dataset), *files, "--split", "test", "--json", str(tmp_path / "scores.json")]
    assert run(words) == DONE
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["dataset"]["images"] == len(truth) == 4
    table = json.loads((out / "comparison.json").read_text())
    assert list(table["detectors"]) == list(TWO_PEERS) and table["order"]["peer_image_passes"] == "100"
    for name in TWO_PEERS:
        row, overall = table["detectors"][name], scores["detectors"][name]["overall"]
        assert row == json.loads(json.dumps(found[name]))
        assert {key: row[key] for key in ("ap", "ap50", "ap75", "recall")} == {
            key: overall[key] for key in ("ap", "ap50", "ap75", "recall")
        }
    assert table["detectors"]["yolov8n"]["ap50"] == 0.0 < table["detectors"]["yolov8s"]["ap50"] < 1.0
    picture = cv2.imread(str(out / "accuracy.png"))
    # Squares of the two peers in both halves.
    blue = cv2.connectedComponents(cv2.inRange(picture, np.array([110, 70, 40]), np.array([150, 110, 80])))[0] - 1
    assert blue == 4


@pytest.mark.parametrize(
    ("points", "front"),
    [
        ([(3.0, 0.9), (1.0, 0.5), (2.0, 0.4), (2.5, 0.9)], [1, 3]),
        ([(1.0, 0.5), (1.0, 0.5), (1.0, 0.7)], [2]),
        ([(2.0, 0.5), (2.0, 0.5)], [0]),
        ([], []),
    ],
)
def test_the_front_holds_what_no_other_beats_in_both(points: list[tuple[float, float]], front: list[int]) -> None:
    assert pareto_front(points) == front


@pytest.mark.slow
def test_the_pairs_of_the_test_dataset_are_scored(screen_dataset: Path, smoke_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for name in TWO_PEERS:
        write_rows_network(out / f"{name}.onnx", np.zeros((2, 5, 2), np.float32))
    compare_peers(order(screen_dataset, tmp_path, test=smoke_dataset), out, lambda line: None)
    scored = json.loads((out / "scores.json").read_text())["dataset"]
    assert scored["sha256"] == Dataset(smoke_dataset).manifest.dataset_sha256


def test_ablations_are_scored_by_the_benchmark_and_one_view_finds_the_same_boxes(
    screen_dataset: Path, tmp_path: Path
) -> None:
    file = write_maps_network(tmp_path / "detector.onnx")
    nowhere = tmp_path / "nowhere"
    ablation = AblationOptions(nowhere, screen_dataset, "s", 1, (64, 64), 1, (0, 1), "cpu", 2)
    rows = measured_networks(ablation, {"eca-asff": [file, file], ONE_VIEW: [file]}, lambda line: None)
    truth = read_detection_truth(screen_dataset)
    boxes = list(DetectorRunner(screen_dataset, lambda drogue: OnnxDetector(file)).boxes(LEAST_SCORE, lambda: None))
    overall = score_detections(truth, {"mine": DetectorOutput(boxes)}, "test").result.detectors["mine"].overall
    assert {box.image_id for box in boxes} > {image.image_id for image in truth.images if image.split == "test"}
    for row, seeds in zip(rows.values(), (2, 1), strict=True):
        # The same numbers from batches of other sizes.
        scores = pytest.approx({key: getattr(overall, key) for key in ("ap", "ap50", "ap75")}, abs=1e-6)
        assert row["test"] == [scores] * seeds
        assert row["ratio"] > 0 and row["parameters"] > 0
    images = Dataset(screen_dataset).images(0)
    one, both = (kind(file).candidates(images, 0.0) for kind in (SingleViewDetector, OnnxDetector))
    for eye in EYES:
        assert len(one[eye]) == len(both[eye]) > 0
        for single, paired in zip(one[eye], both[eye], strict=True):
            assert single.box_xywh_px == pytest.approx(paired.box_xywh_px, abs=1e-3)


def test_a_benchmark_accepts_networks_whose_operations_cannot_be_counted(screen_dataset: Path, tmp_path: Path) -> None:
    plain, odd = (write_maps_network(tmp_path / f"{name}.onnx", name == "plain") for name in ("plain", "odd"))
    words = ["benchmark", str(screen_dataset), "--detector", str(plain), "--detector", str(odd)]
    words += ["--detector", f"{plain}@128x64"]
    assert run([*words, "--json", str(tmp_path / "scores.json")]) == DONE
    scores = json.loads((tmp_path / "scores.json").read_text())["detectors"]
    # Each scale has 64 / stride squared places of 5 channels, each of 3 stride^2 products, and the weights for them.
    assert scores["plain"]["gflops_per_image"] == pytest.approx(2e-9 * 3 * 5 * 3 * 64**2, rel=1e-9)
    assert scores["plain"]["parameters"] == 5 * 3 * (8**2 + 16**2 + 32**2)
    assert scores["plain@128x64"]["gflops_per_image"] == pytest.approx(
        2 * scores["plain"]["gflops_per_image"], rel=1e-9
    )
    assert (scores["odd"]["gflops_per_image"], scores["odd"]["parameters"]) == (None, None)
    assert scores["odd"]["times"]["pairs"] == 6


@pytest.mark.parametrize("changes", [{"image_passes": -1}, {"batch": 0}, {"threads": 0}, {"rounds": 0}])
def test_options_out_of_range_are_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be positive, got"):
        order(tmp_path, tmp_path, **changes)


def test_unknown_peers_are_refused_and_all_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"--peer: must be one of yolov8s, .*, rtmdet-tiny, got yolo3, yolo4"):
        order(tmp_path, tmp_path, peers=("yolo3", "yolov8n", "yolo4"))
    command = [sys.executable, "-m", "studies.detector_comparison", "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[3])
    assert "--peer" in shown.stdout


def test_sizes_have_their_height_first_and_are_multiples_of_32(tmp_path: Path) -> None:
    assert input_size_px("480x640") == (640, 480)
    for text in ("480", "480x", "axb", "-32x64", "9" * 20):
        with pytest.raises(ValueError, match="--size: must be HEIGHTxWIDTH"):
            input_size_px(text)
    with pytest.raises(ValueError, match="size: must be multiples of 32 px, got 100x64"):
        order(tmp_path, tmp_path, size_px=(64, 100))
    with pytest.raises(ValueError, match="size: d-fine-n needs 256 px, got 192x224"):
        order(tmp_path, tmp_path, size_px=(224, 192), peers=("yolov8n", "d-fine-n"))


def test_tables_have_a_line_for_each_network() -> None:
    row = {
        "parameters": 3_011_043,
        "gflops_per_image": 6.1,
        "wall_ms": (50.0, 60.0, 70.0),
        "cpu_ms": (99.0, 100.0, 101.0),
    }
    lines = list(comparison_lines({"a": row | {"ratio": 1.0}, "b": row | {"ratio": 0.4, "ap50": 0.9876, "ap": 0.8}}))
    assert len(lines) == 4 and "CPU / a" in lines[0] and "98.76 %" in lines[2] and "3,011,043" in lines[1]
    tests = [{"ap50": 0.75, "ap": 0.25}, {"ap50": 0.5, "ap": 0.5}]
    ablation = ablation_lines({name: row | {"test": [None]} for name in CHANGES} | {"two seeds": row | {"test": tests}})
    assert len(ablation) == 2 + len(CHANGES)
    assert "62.50 %" in ablation[-1] and "37.50 %" in ablation[-1] and ablation[-1].endswith("25.00 %, 50.00 %")
    with pytest.raises(ValueError, match="--image-passes: must be at least 1, got 0"):
        AblationOptions(Path(), Path(), "s", 0, (64, 64), 1, (0,), "cpu", 1)
    with pytest.raises(ValueError, match=r"--network: must be of eca-asff, .* got none, fpn"):
        AblationOptions(Path(), Path(), "s", 8, (64, 64), 1, (0,), "cpu", 1, ("se", "none", "fpn"))


@pytest.mark.parametrize("name", CHANGES)
def test_every_network_of_the_ablation_can_be_trained_and_differs_from_what_ships(name: str, tmp_path: Path) -> None:
    file = tmp_path / "ablation.toml"
    file.write_text(settings_text(CHANGES[name]))
    settings = build_settings(file, {})
    assert {key: getattr(settings, key) for key in CHANGES[name]} == CHANGES[name]
    assert (settings == build_settings(None, {})) == (name == next(iter(CHANGES)))


def test_a_test_that_is_not_there_is_found_before_training(screen_dataset: Path, tmp_path: Path) -> None:
    ablation = AblationOptions(screen_dataset, tmp_path / "nowhere", "s", 8, (64, 64), 1, (0,), "cpu", 1)
    with pytest.raises(ValueError, match="nowhere"):
        ablate(ablation, tmp_path / "out", lambda line: None)
    assert not (tmp_path / "out").exists()
