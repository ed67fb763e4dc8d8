"""What is asked of the peers, without their environment: their corpus, the length of their training, and faults."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from datasets_manifest.reader import Dataset
from datasets_manifest.recipe import load_recipe, parse_recipe
from droguekit.batch.local import render_dataset
from droguekit.batch.progress import PlainProgress
from droguekit.detector_peers.ablation import CHANGES, AblationOrder, ablation_lines
from droguekit.detector_peers.comparison import PeerOrder, compare_peers, run_script, training_length
from droguekit.detector_peers.options import input_size_px
from droguekit.detector_peers.table import comparison_lines
from droguekit.detector_peers.yolo_corpus import export_corpus, images_to_train_on


@pytest.fixture(scope="module")
def screen_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four small pairs as a screen wants them, two to train and two to validate on, one of them empty."""
    _, text = load_recipe("smoke")
    changed = text.replace('preset = "rgb-ideal"', 'preset = "rgb-ideal"\nencoding = "gamma"')
    changed = changed.replace("count = 6", "count = 4\nempty_fraction = 0.25").replace("val = 0.0", "val = 0.5")
    changed = changed.replace("test = 0.5", "test = 0.0").replace("[render]", '[render]\nengine = "analytic"')
    recipe = parse_recipe(changed)
    out = tmp_path_factory.mktemp("screen") / "dataset"
    with (out.parent / "log").open("w") as told:
        render_dataset(recipe, changed, out, range(4), 0, PlainProgress(told))
    return out


def order(corpus: Path, folder: Path, **changes: object) -> PeerOrder:
    values: dict[str, object] = {
        "corpus": corpus,
        "ours": (),
        "image_passes": 100,
        "size_px": (64, 64),
        "batch": 4,
        "threads": 1,
        "rounds": 2,
        "device": "cpu",
        "seed": 0,
        "environment": folder / "environment",
    }
    return PeerOrder(**{**values, **changes})  # type: ignore[arg-type]


def test_the_corpus_of_the_peers_has_one_class_and_our_boxes(screen_dataset: Path, tmp_path: Path) -> None:
    data = export_corpus(screen_dataset, tmp_path / "corpus")
    assert data.read_text().endswith("names:\n  0: drogue\n")
    annotations = json.loads((screen_dataset / "annotations" / "all.json").read_text())
    expected = {annotation["image_id"]: annotation["bbox"] for annotation in annotations["annotations"]}
    camera = Dataset(screen_dataset).manifest.recipe.rig.camera
    labels = sorted((data.parent / "labels").rglob("*.txt"))
    assert len(labels) == 8 and images_to_train_on(screen_dataset) == 4
    for label in labels:
        frame, eye = label.stem.split("_")
        rows = [[float(number) for number in row.split()] for row in label.read_text().splitlines()]
        box = expected.get(2 * int(frame) + (eye == "right") + 1)
        assert len(rows) == (box is not None)
        if box is not None:
            number, x, y, width, height = rows[0]
            found = [(x - width / 2) * camera.width_px, (y - height / 2) * camera.height_px]
            # Divided by the image's size and multiplied by it again, in double precision.
            assert number == 0 and found == pytest.approx(box[:2], abs=1e-9)
        picture = data.parent / "images" / label.relative_to(data.parent / "labels").with_suffix(".png")
        assert cv2.imread(str(picture)) is not None
    # What is there already stays.
    label.write_text("")
    export_corpus(screen_dataset, tmp_path / "corpus")
    assert label.read_text() == ""


def test_a_corpus_that_ultralytics_would_see_otherwise_is_refused(smoke_dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"encoded for a screen \(gamma\), got 8 bits, linear"):
        export_corpus(smoke_dataset, tmp_path / "corpus")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("passes", "images"), [(1, 1000), (300, 1000), (1000, 1000), (1001, 1000), (40_000, 1_680), (10, 3)]
)
def test_so_many_passes_are_made(passes: int, images: int) -> None:
    epochs, fraction = training_length(passes, images)
    assert 0 < fraction <= 1 and epochs == int(epochs)
    # ultralytics takes a whole number of images in each epoch.
    assert epochs * fraction * images == pytest.approx(passes, rel=1e-12)


def test_a_training_without_images_is_refused() -> None:
    with pytest.raises(ValueError, match="has no images to train on"):
        training_length(100, 0)


def test_a_fault_of_the_peers_names_the_log_and_what_was_said_last(tmp_path: Path) -> None:
    # Our own interpreter has no ultralytics.
    with pytest.raises(OSError, match=r"export\.log: ultralytics ended with status 1: ModuleNotFoundError"):
        run_script(Path(sys.executable), {"do": "export"}, tmp_path / "new" / "export.log", {})


def test_the_script_needs_nothing_of_ours() -> None:
    # In isolated mode with another folder as home, as in the peers' environment.
    script = Path(run_script.__code__.co_filename).with_name("yolo_script.py")
    ended = subprocess.run([sys.executable, "-I", str(script)], input="{}", capture_output=True, text=True, check=False)
    assert "No module named 'ultralytics'" in ended.stderr


def test_a_folder_of_another_comparison_is_refused(screen_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "settings.json").write_text(json.dumps({"image_passes": "7"}))
    with pytest.raises(ValueError, match="holds a comparison with another batch, corpus, image_passes, seed, size_px"):
        compare_peers(order(screen_dataset, tmp_path), out, print)
    (out / "settings.json").write_text("{")
    with pytest.raises(ValueError, match=r"settings\.json: is not JSON"):
        compare_peers(order(screen_dataset, tmp_path), out, print)


@pytest.mark.parametrize("changes", [{"image_passes": -1}, {"batch": 0}, {"threads": 0}, {"rounds": 0}])
def test_absurd_numbers_are_refused(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be positive, got"):
        order(tmp_path, tmp_path, **changes)


def test_sizes_have_their_height_first_and_are_multiples_of_32(tmp_path: Path) -> None:
    assert input_size_px("480x640") == (640, 480)
    for text in ("480", "480x", "axb", "-32x64", "9" * 20):
        with pytest.raises(ValueError, match="--size: must be HEIGHTxWIDTH"):
            input_size_px(text)
    with pytest.raises(ValueError, match="size: must be multiples of 32 px, got 100x64"):
        order(tmp_path, tmp_path, size_px=(64, 100))


def test_tables_have_a_line_for_each_network() -> None:
    row = {
        "parameters": 3_011_043,
        "gflops_per_image": 6.1,
        "wall_ms": (50.0, 60.0, 70.0),
        "cpu_ms": (99.0, 100.0, 101.0),
    }
    lines = list(comparison_lines({"a": row | {"ratio": 1.0}, "b": row | {"ratio": 0.4, "ap50": 0.9876, "ap": 0.8}}))
    assert len(lines) == 4 and "CPU / a" in lines[0] and "98.76 %" in lines[2] and "3,011,043" in lines[1]
    ablation = ablation_lines({name: row | {"test": None} for name in CHANGES})
    assert len(ablation) == 1 + len(CHANGES)
    with pytest.raises(ValueError, match="--image-passes: must be at least 1, got 0"):
        AblationOrder(Path(), "s", 0, (64, 64), 1, 0, "cpu", 1)
