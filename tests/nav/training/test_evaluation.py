from __future__ import annotations

import io
import warnings
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch

from datasets_manifest.types.images import StereoImages
from droguekit.batch.progress import PlainProgress
from droguekit.scoring.detection.detector_runner import DetectorRunner
from droguekit.scoring.results.detection_result import image_id_of
from geometry.stereo import EYES
from nav.detector.input_image import letterbox
from nav.detector.model_metadata import ModelMetadata
from nav.detector.onnx_detector import OnnxDetector
from nav.detector.output_maps import STRIDES
from nav.training.corpus import Corpus, open_corpus
from nav.training.evaluation import (
    Search,
    average_precision,
    best_threshold,
    detect_split,
    measure_batch_statistics,
    predict,
    to_tensor,
    whole_image,
)
from nav.training.training_settings import TrainingSettings
from nav.training.training_state import ComputeDevice, new_network
from tests.support.detector_networks import set_metadata

NONE = (np.zeros((0, 4)), np.zeros(0))
BOX = np.array([[10.0, 10.0, 20.0, 20.0]])


def found(score: float, shift_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return BOX + np.array([shift_px, 0, 0, 0]), np.array([score])


def test_average_precision_of_cases_that_are_worked_by_hand() -> None:
    empty = np.zeros((0, 4))
    perfect = average_precision([BOX, BOX], [found(0.9), found(0.8)])
    assert perfect is not None and (perfect.ap, perfect.ap50, perfect.recall50) == (1.0, 1.0, 1.0)
    half = average_precision([BOX, BOX], [found(0.9), NONE])
    # 51 of COCO's 101 recall levels lie at or below one half.
    assert half is not None and half.ap50 == pytest.approx(51 / 101) and half.recall50 == 0.5
    alarm = average_precision([BOX, empty], [found(0.5), found(0.9)])
    assert alarm is not None and alarm.ap50 == pytest.approx(0.5)  # every level at a precision of 1 in 2
    # Shifted by 4 of 20 px the IoU is 16 / 24 = 0.67: right at 0.5, 0.55, 0.6 and 0.65.
    shifted = average_precision([BOX], [found(0.9, 4.0)])
    assert shifted is not None and (shifted.ap50, shifted.ap75, shifted.ap) == pytest.approx((1.0, 0.0, 0.4))
    nothing = average_precision([BOX], [NONE])
    assert nothing is not None and nothing.ap50 == 0.0
    assert average_precision([empty], [found(0.9)]) is None


def test_the_threshold_separates_right_boxes_from_wrong_ones() -> None:
    empty = np.zeros((0, 4))
    truth = [BOX, BOX, empty, empty]
    assert best_threshold(truth, [found(0.9), found(0.7), found(0.5), NONE], 0.1) == pytest.approx(0.6)
    # A box beside the drogue is wrong.
    assert best_threshold(truth, [found(0.9), found(0.7, 15.0), NONE, NONE], 0.1) == pytest.approx(0.8)
    assert best_threshold(truth, [NONE] * 4, 0.1) == 0.1


def test_the_best_box_may_be_that_of_any_drogue_in_the_image() -> None:
    two = np.vstack([BOX + np.array([50, 0, 0, 0]), BOX])
    assert best_threshold([two, BOX], [found(0.7), found(0.9)], 0.1) == pytest.approx(0.35)


def test_the_threshold_is_the_middle_of_those_that_differ_by_chance() -> None:
    empty = np.zeros((0, 4))
    # Nine drogues are found, then wrong and right boxes alternate, and one drogue is missed. From the eighth box on,
    # four or five of all are wrong or missing.
    right = [0.99 - 0.01 * k for k in range(9)]
    mixed = [(0.8, False), (0.7, True), (0.6, False), (0.5, True), (0.4, False), (0.3, True), (0.2, False)]
    truth = [BOX] * 9 + [BOX if is_right else empty for _, is_right in mixed] + [BOX]
    predictions = [found(score) for score in right] + [found(score) for score, _ in mixed] + [NONE]
    # Thrice as many images without a drogue as with one, of which there are thirteen: a box in them counts once.
    many = truth + [empty] * 35, predictions + [NONE] * 35
    assert best_threshold(*many, 0.1) == pytest.approx(right[7] / 2)
    # With as many of both it counts three times: lower thresholds are worse by more than chance.
    even = truth + [empty] * 9, predictions + [NONE] * 9
    assert best_threshold(*even, 0.1) == pytest.approx((right[7] + 0.8) / 2)
    # With four, a box in one of them has the weight 3 x 13 / 4.
    assert best_threshold(truth, predictions, 0.1) == pytest.approx((right[7] + 0.8) / 2)


def test_batch_statistics_are_those_of_one_pass_over_all_images(ellipse_corpus: Corpus) -> None:
    size_px, compute = (64, 96), ComputeDevice(torch.device("cpu"), bf16=False)
    network = new_network(TrainingSettings(variant="s")).eval()
    weights = {name: value.clone() for name, value in network.named_parameters()}
    momenta = [layer.momentum for layer in normalizations(network)]
    measure_batch_statistics(network, ellipse_corpus, size_px, compute)
    first = {name: value.clone() for name, value in network.state_dict().items()}
    # The input of the first one does not depend on any before it.
    images = np.stack([whole_image(ellipse_corpus, pair, eye, size_px)[0] for pair in range(12) for eye in (0, 1)])
    seen: list[tuple[torch.nn.Module, torch.Tensor]] = []
    hooks = [
        layer.register_forward_pre_hook(lambda layer, inputs: seen.append((layer, inputs[0])))
        for layer in normalizations(network)
    ]
    with torch.no_grad():
        network(to_tensor(images, compute))
    for hook in hooks:
        hook.remove()
    layer, values = seen[0]
    # The batches, of every second image, weigh equally. Each sums 18,432 numbers in float32, one after another: up to
    # so many roundings of 6e-8, which are alike where the images are plain black.
    torch.testing.assert_close(layer.running_mean, values.mean(dim=(0, 2, 3)), rtol=1e-3, atol=1e-4)
    within = torch.stack([batch.var(dim=(0, 2, 3)) for batch in (values[::2], values[1::2])]).mean(dim=0)
    torch.testing.assert_close(layer.running_var, within, rtol=1e-3, atol=1e-4)
    measure_batch_statistics(network, ellipse_corpus, size_px, compute)
    for name, value in network.state_dict().items():
        torch.testing.assert_close(value, first[name], rtol=1e-5, atol=1e-6)
    assert all(torch.equal(value, weights[name]) for name, value in network.named_parameters())
    assert [layer.momentum for layer in normalizations(network)] == momenta
    assert not any(module.training for module in network.modules())


def normalizations(network: torch.nn.Module) -> list[torch.nn.BatchNorm2d]:
    return [module for module in network.modules() if isinstance(module, torch.nn.BatchNorm2d)]


class BrightCells(torch.nn.Module):
    """Boxes of two cells around bright cells; the score is a half where three quarters of a cell are white."""

    def forward(self, images: torch.Tensor) -> list[torch.Tensor]:
        cells = [torch.nn.functional.avg_pool2d(images, stride).mean(dim=1, keepdim=True) for stride in STRIDES]
        return [torch.cat((40 * each - 30, *[torch.zeros_like(each)] * 4), dim=1) for each in cells]


def bright_cells_file(file: Path, size_px: tuple[int, int], metadata: ModelMetadata) -> Path:
    axes = {0: "b", 2: "h", 3: "w"}
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        torch.onnx.export(
            BrightCells().eval(),
            (torch.zeros(2, 3, *size_px),),
            file,
            input_names=["images"],
            dynamic_axes={"images": axes},
            dynamo=False,
        )
    set_metadata(file, metadata)
    return file


def test_a_learning_network_searches_as_the_detector_exported_from_it_without_a_second_look(
    ellipse_corpus: Corpus, tmp_path: Path
) -> None:
    size_px = ellipse_corpus.size_px
    metadata = ModelMetadata(input_size_px=size_px[::-1])
    detector = OnnxDetector(bright_cells_file(tmp_path / "bright.onnx", size_px, metadata))
    compute = ComputeDevice(torch.device("cpu"), bf16=False)
    seen = predict(BrightCells().eval(), ellipse_corpus, "train", Search(size_px, 5, 0.0), compute)
    placement = letterbox(size_px[::-1], size_px[::-1])
    number = 0
    for pair in ellipse_corpus.split("train"):
        left, right = (ellipse_corpus.image(int(pair), eye) for eye in (0, 1))
        images = StereoImages(left, right, time_s=0.0, exposure_s=1e-3, encoding="gamma")
        candidates = detector.candidates(images, 0.01)
        for eye in EYES:
            boxes, scores = seen.found[number]
            wanted = candidates[eye][: len(scores)]
            np.testing.assert_allclose(scores, [one.score for one in wanted], rtol=0, atol=1e-5)
            np.testing.assert_allclose(
                placement.to_image(boxes), [one.box_xywh_px for one in wanted], rtol=0, atol=1e-3
            )
            number += 1


def test_a_split_is_evaluated_with_the_boxes_that_detect_writes(split_dataset: Path, tmp_path: Path) -> None:
    # Of another shape than the pictures, so that there are bars beside them.
    size_px = (96, 160)
    corpus = open_corpus([split_dataset], tmp_path / "cache", size_px, 1, PlainProgress(io.StringIO()))
    metadata = ModelMetadata(input_size_px=size_px[::-1], small_below_px=80.0)
    detector = OnnxDetector(bright_cells_file(tmp_path / "bright.onnx", size_px, metadata))
    seen = detect_split(detector, corpus, "train")
    pairs = [int(pair) for pair in corpus.split("train")]
    runner = DetectorRunner(split_dataset, lambda _: detector, [corpus.entry(pair).frame_index for pair in pairs])
    written = defaultdict(list)
    for box in runner.boxes(0.01, lambda: None):
        written[box.image_id].append(box)
    # A picture of 320 x 240 px fills the height of the input, and 128 of its 160 columns.
    scale = 96 / 240
    assert sum(map(len, written.values())) > len(pairs)
    images = [(pair, eye) for pair in pairs for eye in (0, 1)]
    for (pair, eye), (boxes, scores) in zip(images, seen.found, strict=True):
        of_image = written[image_id_of(corpus.entry(pair).frame_index, EYES[eye])]
        wanted = np.array([box.box_xywh for box in of_image]).reshape(-1, 2, 2) * scale + [[16, 0], [0, 0]]
        # Scales and offsets are exact; what is left are roundings of 1e-14 or so.
        np.testing.assert_allclose(boxes, wanted.reshape(-1, 4), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(scores, [box.score for box in of_image])
    for (pair, eye), truth in zip(images, seen.truth, strict=True):
        np.testing.assert_array_equal(truth, corpus.boxes(pair, eye))
