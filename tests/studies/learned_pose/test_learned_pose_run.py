"""The whole chain at a small size: corpus, training that resumes, all estimators on one pair."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datasets_manifest.recipe.recipe import Recipe
from droguekit.api.recipe_rendering import load_recipe, render_dataset
from droguekit.api.stereo_dataset import StereoDataset
from geometry.se3 import Array
from studies.learned_pose.__main__ import StudyOptions, check_folder, score_all
from studies.learned_pose.estimators import ESTIMATORS, OURS, SIMCC, SIMCC_STEREO, YOLO, KeypointSource
from studies.learned_pose.keypoint_corpus import KeypointCorpus, eye_sample, keypoint_sigma_px, load_corpus
from studies.learned_pose.keypoint_crops import PATCH_PX, CropView, crop_from_patch, map_points
from studies.learned_pose.keypoint_training import SimccTraining, train_simcc, training_batch
from studies.learned_pose.ring_keypoints import clockwise_from_top
from studies.learned_pose.yolo_pose import YoloTraining, export_crops

STUDY = Path(__file__).parents[3] / "studies" / "learned_pose"
SMALL_RIG = {"preset": "rgb-ideal", "width_px": 640, "height_px": 480, "focal_px": 1066.7}


def small_recipe(name: str, count: int) -> Recipe:
    return load_recipe(
        str(STUDY / f"{name}.toml"),
        rig=SMALL_RIG,
        frames={"count": count, "scenes": count},
        distance={"low_m": 3.0, "high_m": 8.0, "edges_m": [3.0, 8.0], "weights": [1]},
        render={"engine": "analytic"},
        split={"train": 0.5, "val": 0.5, "test": 0},
    )


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("learned") / "corpus"
    render_dataset(small_recipe("train", 4), out, workers=0)
    return out


def drawn_corpus() -> KeypointCorpus:
    """Rings of red spots on grey."""
    rng = np.random.default_rng(0)
    patches = np.full((8, PATCH_PX, PATCH_PX, 3), 90, np.uint8)
    angles = np.pi / 4 * np.arange(8)
    markers = []
    for patch in patches:
        turned = angles + rng.uniform(0, np.pi / 4)
        points = PATCH_PX / 2 + rng.uniform(60, 80) * np.column_stack([np.cos(turned), np.sin(turned)])
        for x, y in np.rint(points).astype(int):
            patch[y - 6 : y + 7, x - 6 : x + 7] = [220, 30, 30]
        markers.append(points)
    return KeypointCorpus(patches, np.array(markers))


def silent(line: str) -> None:
    """Tell nobody."""


def test_recipes_share_no_scenes_and_draw_the_same_drogue() -> None:
    train, test = (load_recipe(str(STUDY / f"{name}.toml")) for name in ("train", "test"))
    assert train.seed != test.seed and train.name != test.name
    assert train.drogue == test.drogue and train.environment == test.environment and train.pose == test.pose
    # Benchmarks need a renderer less noisy than the camera.
    assert train.render.noise_over_sensor == 1.0 and test.render.noise_over_sensor < 0.5


def test_a_training_learns_and_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("studies.learned_pose.keypoint_training._STEPS_PER_CHECKPOINT", 4)
    training = SimccTraining(image_passes=32, batch=4)
    whole_lines: list[str] = []
    train_simcc(drawn_corpus, tmp_path / "whole", training, whole_lines.append)
    losses = [float(line.split("loss ")[1]) for line in whole_lines]
    assert len(losses) == 2 and losses[1] < losses[0]

    class StoppedError(Exception):
        pass

    def stop(line: str) -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        train_simcc(drawn_corpus, tmp_path / "stopped", training, stop)
    train_simcc(drawn_corpus, tmp_path / "stopped", training, silent)
    whole, stopped = (
        torch.load(tmp_path / name / "network.pt", weights_only=True)["network"] for name in ("whole", "stopped")
    )
    # The same steps on one thread: the same bits.
    assert all(torch.equal(whole[name], stopped[name]) for name in whole)


def test_another_training_does_not_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("studies.learned_pose.keypoint_training._STEPS_PER_CHECKPOINT", 1)
    training = SimccTraining(image_passes=2, batch=2)
    train_simcc(drawn_corpus, tmp_path, training, silent)
    (tmp_path / "network.pt").unlink()
    with pytest.raises(ValueError, match="is of a training with other options"):
        train_simcc(drawn_corpus, tmp_path, replace(training, seed=1), silent)
    with pytest.raises(ValueError, match="training: numbers must be positive"):
        SimccTraining(image_passes=0)


def test_a_folder_keeps_its_trainings(tmp_path: Path) -> None:
    yolo = YoloTraining(image_passes=100, batch=16, threads=1, seed=0, environment=tmp_path)
    options = StudyOptions(1, yolo, SimccTraining(image_passes=200))
    check_folder(options, tmp_path / "out")
    # Workers and threads do not count.
    check_folder(StudyOptions(2, replace(yolo, threads=2), options.simcc), tmp_path / "out")
    with pytest.raises(ValueError, match="holds other trainings"):
        check_folder(replace(options, yolo=replace(yolo, image_passes=101)), tmp_path / "out")
    with pytest.raises(ValueError, match="holds other trainings"):
        check_folder(replace(options, simcc=replace(options.simcc, seed=1)), tmp_path / "out")


def test_the_rate_rises_and_falls_to_zero() -> None:
    training = SimccTraining(image_passes=1600, batch=16, learning_rate=1.0)
    rates = [training.learning_rate_at(step) for step in range(training.steps)]
    assert rates[0] == pytest.approx(1 / 5) and max(rates) == pytest.approx(1.0) and rates[-1] < 1e-3
    # A crop is drawn by step and place alone.
    corpus = drawn_corpus()
    first, second = (training_batch(corpus, training, 3) for _ in range(2))
    assert np.array_equal(first[0], second[0]) and np.array_equal(first[1], second[1])
    assert not np.array_equal(first[0], training_batch(corpus, training, 4)[0])


def test_the_deviation_is_that_of_the_points() -> None:
    corpus = drawn_corpus()
    true = map_points(crop_from_patch(CropView()), corpus.markers_px)
    places = iter(range(0, len(corpus), 2))
    rng = np.random.default_rng(5)

    def find(crops: Sequence[np.ndarray]) -> list[Array]:
        first = next(places)
        return [rng.permutation(true[first + k] + rng.normal(0, 0.8, (8, 2))) for k in range(len(crops))]

    # The median of 128 numbers errs by 1.2 / sqrt(128) = 10 % of the deviation.
    assert keypoint_sigma_px(find, corpus) == pytest.approx(0.8, rel=0.4)
    with pytest.raises(ValueError, match="keypoints: none is found"):
        keypoint_sigma_px(lambda crops: [np.zeros((0, 2))] * 2, corpus)


def test_crops_of_a_corpus_show_the_markers(corpus: Path, tmp_path: Path) -> None:
    loaded = load_corpus(corpus, "train")
    assert loaded.patches.shape == (4, PATCH_PX, PATCH_PX, 3) and loaded.markers_px.shape == (4, 8, 2)
    for patch, markers in zip(loaded.patches, loaded.markers_px, strict=True):
        red, green = patch[..., 0].astype(int), patch[..., 1].astype(int)
        x, y = np.rint(markers).astype(int).T
        assert (red[y, x] > green[y, x] + 30).all()
    data = export_crops(corpus, tmp_path / "crops").read_text(encoding="utf-8")
    assert "kpt_shape: [8, 3]" in data and "flip_idx: [7, 6, 5, 4, 3, 2, 1, 0]" in data
    labels = sorted((tmp_path / "crops" / "labels").rglob("*.txt"))
    assert len(labels) == 8 and len({label.read_text(encoding="utf-8") for label in labels}) == 8
    with pytest.raises(ValueError, match="has no pairs in the split test"):
        load_corpus(corpus, "test")


def test_all_estimators_score_one_pair(corpus: Path) -> None:
    pair = next(iter(StereoDataset(corpus)))
    record, images = pair.record, pair.images
    truth = [eye_sample(record, images, eye) for eye in ("left", "right")]
    assert truth[0].box_xywh_px == eye_sample(record, images, "left").box_xywh_px != truth[1].box_xywh_px

    def with_noise(sigma_px: float, shift: int) -> Callable[[Sequence[np.ndarray]], list[Array]]:
        def find(crops: Sequence[np.ndarray]) -> list[Array]:
            rng, found = np.random.default_rng(0), []
            for sample in truth:
                points = map_points(crop_from_patch(CropView()), sample.markers_px)
                found.append(np.roll(points[clockwise_from_top(points)], shift, axis=0))
            return [points + rng.normal(0, sigma_px, points.shape) for points in found]

        return find

    exact, rough = KeypointSource(with_noise(1e-3, 0), 1e-3), KeypointSource(with_noise(0.5, 0), 0.5)
    scores = score_all(record, images, rough, exact)
    assert tuple(scores.scores) == ESTIMATORS and 3.0 <= scores.distance_m < 8.0
    by_name = {name: max(score.position_m for score in found) for name, found in scores.scores.items()}
    # 0.001 px of the crop are far below what the light allows, 0.5 px far above.
    assert by_name[SIMCC_STEREO] < scores.bound_m < by_name[YOLO]
    assert by_name[OURS] < 5 * scores.bound_m
    # Another start of the numbering changes no position.
    moved = score_all(record, images, rough, KeypointSource(with_noise(1e-3, 3), 1e-3))
    assert len(moved.scores[SIMCC]) == 2
    assert max(score.position_m for score in moved.scores[SIMCC]) < 2 * by_name[SIMCC] + 1e-5
    # A network that finds nothing has no pose.
    blind = KeypointSource(lambda crops: [np.zeros((0, 2))] * 2, 1.0)
    missing = score_all(record, images, blind, exact).scores[YOLO]
    assert all(np.isinf(score.position_m) for score in missing)
