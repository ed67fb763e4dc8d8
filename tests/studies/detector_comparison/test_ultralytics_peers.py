"""Networks of other projects: their output rows become boxes in image pixels, and their cost is that by hand."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from datasets_manifest.types.images import StereoImages
from geometry.stereo import Eye
from nav.detector.detector import Detection, StereoDetection
from nav.detector.onnx_cost import network_cost
from studies.detector_comparison.latency import _latency, measure_latency
from studies.detector_comparison.ultralytics_peers import YoloDetector, decode_corners, decode_rows
from tests.support.detector_networks import write_rows_network


def images(width_px: int = 128, height_px: int = 96) -> StereoImages:
    picture = np.full((height_px, width_px, 3), 90, np.uint8)
    return StereoImages(left=picture, right=picture, time_s=0.0, exposure_s=1e-3, encoding="gamma")


def test_rows_become_corners_best_first_without_doubles() -> None:
    # Middle x, y, width, height, score: the second box is the best, the first overlaps it by 0.8 and the third not at
    # all; the last scores too little.
    rows = np.array([[50, 52, 200, 9], [50, 50, 100, 9], [36, 36, 20, 2], [36, 36, 40, 2], [0.6, 0.9, 0.7, 0.01]])
    boxes, scores = decode_rows(rows.astype(np.float32), 0.25)
    np.testing.assert_allclose(boxes, [[34, 32, 36, 36], [190, 80, 20, 40]])
    # Single precision of the network's numbers.
    np.testing.assert_allclose(scores, [0.9, 0.7], rtol=1e-6)


def test_corners_of_networks_without_suppression_become_boxes(tmp_path: Path) -> None:
    # Low and high corner, score, class; both boxes stay, though they overlap.
    rows = np.array([[10, 20, 30, 60, 0.6, 0], [10, 20, 30, 62, 0.9, 0], [1, 2, 3, 4, 0.1, 0]], np.float32)
    boxes, scores = decode_corners(rows, 0.25)
    np.testing.assert_allclose(boxes, [[10, 20, 20, 42], [10, 20, 20, 40]])
    np.testing.assert_allclose(scores, [0.9, 0.6], rtol=1e-6)
    # The same through a file: of 128 x 96 px that fit into 64 x 64 from row 8 on.
    detector = YoloDetector(write_rows_network(tmp_path / "corners.onnx", np.stack([rows, 0 * rows])), 1)
    found = detector.candidates(images(), 0.25)
    assert found["right"] == () and len(found["left"]) == 2
    np.testing.assert_allclose(found["left"][0].box_xywh_px, [19.5, 23.5, 40, 84], atol=1e-4)


def test_nothing_found_is_no_box() -> None:
    boxes, scores = decode_rows(np.zeros((5, 100), np.float32), 0.25)
    assert (boxes.shape, scores.shape) == ((0, 4), (0,))


def test_boxes_stand_in_the_full_sized_image_counted_from_pixel_centres(tmp_path: Path) -> None:
    rows = np.zeros((2, 5, 3), np.float32)
    # The whole picture of the left eye: 128 x 96 px fit into 64 x 64 as 64 x 48, from row 8 to 56.
    rows[0, :, 0] = [32, 32, 64, 48, 0.8]
    detector = YoloDetector(write_rows_network(tmp_path / "rows.onnx", rows), 1)
    found = detector.candidates(images(), 0.25)
    assert found["right"] == ()
    np.testing.assert_allclose(found["left"][0].box_xywh_px, [-0.5, -0.5, 128, 96], atol=1e-4)
    best = detector.detect(images())
    assert best.right is None and best.left == found["left"][0]


@pytest.mark.parametrize("content", [None, b"", b"no network"])
def test_files_that_are_no_networks_are_named(tmp_path: Path, content: bytes | None) -> None:
    file = tmp_path / "bad.onnx"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.onnx"):
        YoloDetector(file, 1)


def test_networks_of_another_kind_are_refused(tmp_path: Path) -> None:
    file = write_rows_network(tmp_path / "flat.onnx", np.zeros((2, 5), np.float32))
    with pytest.raises(ValueError, match="must take two images and give rows of boxes"):
        YoloDetector(file, 1)


# torch warns that the exporter by tracing will go.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_parameters_and_operations_are_what_a_hand_counts(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Conv2d(3, 8, 3, stride=2, padding=1),
        torch.nn.ReLU(),
        torch.nn.Conv2d(8, 8, 5, padding=2, groups=8, bias=False),
        torch.nn.AdaptiveAvgPool2d(1),
        torch.nn.Flatten(),
        torch.nn.Linear(8, 4),
    ).eval()
    file = tmp_path / "small.onnx"
    torch.onnx.export(
        network,
        (torch.zeros(2, 3, 32, 32),),
        str(file),
        input_names=["images"],
        dynamic_axes={"images": {0: "batch", 2: "height", 3: "width"}},
        dynamo=False,
    )
    cost = network_cost(file, (64, 96))
    assert cost.parameters == sum(each.numel() for each in network.parameters())
    # First layer: 48 x 32 places of 8 channels, 27 products each; second: 25 each; last: 4 sums of 8.
    products = 48 * 32 * 8 * (27 + 25) + 4 * 8
    assert cost.gflops_per_image == pytest.approx(2e-9 * products, rel=1e-12)


def test_what_is_no_network_has_no_cost(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.onnx: cannot be read"):
        network_cost(tmp_path / "none.onnx", (64, 64))
    (tmp_path / "bad.onnx").write_bytes(b"no network at all")
    with pytest.raises(ValueError, match=r"bad\.onnx: is not an ONNX network"):
        network_cost(tmp_path / "bad.onnx", (64, 64))


def test_a_network_with_operations_of_somebody_else_has_no_cost(tmp_path: Path) -> None:
    node = helper.make_node("FusedConv", ["images", "weights"], ["answer"], domain="com.microsoft")
    weights = helper.make_tensor("weights", TensorProto.FLOAT, [4, 3, 1, 1], [0.0] * 12)
    graph = helper.make_graph(
        [node],
        "of a domain that is not named",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [2, 3, 64, 64])],
        [helper.make_tensor_value_info("answer", TensorProto.FLOAT, None)],
        [weights],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), str(tmp_path / "odd.onnx"))
    with pytest.raises(ValueError, match=r"odd\.onnx: its shapes cannot be inferred"):
        network_cost(tmp_path / "odd.onnx", (64, 64))


class Tallying:
    """Finds nothing, and records the order of its calls."""

    def __init__(self, name: str, asked: list[str]) -> None:
        self.name = name
        self._asked = asked

    def detect(self, images: StereoImages) -> StereoDetection:
        return StereoDetection(None, None)

    def candidates(self, images: StereoImages, least_score: float) -> dict[Eye, tuple[Detection, ...]]:
        self._asked.append(self.name)
        return {}


def test_detectors_take_turns_in_every_order() -> None:
    asked: list[str] = []
    told: list[None] = []
    detectors = {name: Tallying(name, asked) for name in "abc"}
    latencies = measure_latency(detectors, [images()], 60, lambda: told.append(None))
    rounds = ["".join(asked[k : k + 3]) for k in range(0, len(asked), 3)][-60:]
    # One of six orders is missing in 60 rounds with the chance 6 (5/6)^60 = 1e-4, and the draw is always the same.
    assert set(rounds) == {"".join(order) for order in itertools.permutations("abc")}
    assert len(told) == 60
    assert list(latencies) == ["a", "b", "c"]
    assert all(list(each.wall_ms) == sorted(each.wall_ms) for each in latencies.values())


def test_ratios_are_of_the_same_rounds() -> None:
    # Wall and CPU time of 101 rounds of 1 to 100 ms: the other takes twice as long in each, at the same time.
    quick = np.column_stack([np.linspace(1, 101, 101), np.linspace(0, 100, 101) + 1])
    latency = _latency(quick, 2 * quick)
    assert latency.ratio == pytest.approx(0.5, rel=1e-12)
    # Percentiles of equal steps.
    assert latency.wall_ms == pytest.approx((51.0, 91.0, 100.0))
    assert latency.mean_cpu_ms == pytest.approx(51.0)


def test_timing_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="needs detectors, pairs and a round, got 0, 1, 5"):
        measure_latency({}, [images()], 5)
