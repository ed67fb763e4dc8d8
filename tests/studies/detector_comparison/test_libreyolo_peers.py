"""D-FINE and RTMDet of libreyolo: their outputs as boxes, the tasks of their script, and their own project's boxes."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from datasets_manifest.types.images import StereoImages
from nav.detector.onnx_cost import network_cost
from studies.detector_comparison.libreyolo_peers import DfineDetector, RtmdetDetector, decode_cells, decode_queries
from studies.detector_comparison.libreyolo_script import non_maximum_suppression, training_data
from studies.detector_comparison.peer_environment import run_script, script_variables
from studies.detector_comparison.peers import PEERS
from tests.support.detector_networks import write_rows_network
from tests.support.other_python import read_by, variable_of


def images(picture: np.ndarray) -> StereoImages:
    return StereoImages(left=picture, right=picture, time_s=0.0, exposure_s=1e-3, encoding="gamma")


def write_queries_network(path: Path, logits: np.ndarray, boxes: np.ndarray) -> Path:
    """A network for two images of 64 x 64 px with constant outputs, as D-FINE has them."""
    outputs = {"pred_logits": logits.astype(np.float32), "pred_boxes": boxes.astype(np.float32)}
    constants = [numpy_helper.from_array(values, f"{name}_rows") for name, values in outputs.items()]
    graph = helper.make_graph(
        [helper.make_node("Identity", [f"{name}_rows"], [name]) for name in outputs],
        "queries",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [2, 3, 64, 64])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, list(rows.shape)) for name, rows in outputs.items()],
        constants,
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


def test_queries_become_boxes_best_first_and_none_is_suppressed() -> None:
    # Two of the same box; the last scores too little.
    logits = np.array([[0.0], [np.log(9)], [-9.0]], np.float32)
    boxes = np.array([[0.5, 0.25, 0.5, 0.25], [0.5, 0.25, 0.5, 0.25], [0.1, 0.1, 0.1, 0.1]], np.float32)
    found, scores = decode_queries(logits, boxes, (200, 80), 0.25)
    np.testing.assert_allclose(found, [[50, 10, 100, 20]] * 2)
    # Single precision of the network's numbers.
    np.testing.assert_allclose(scores, [0.9, 0.5], rtol=1e-6)


def test_cells_become_boxes_cut_to_the_input_without_doubles() -> None:
    # The second overlaps the first, cut to the input, by 0.9; the third lies outside, the last scores too little.
    rows = np.array(
        [[-9, 10, 30, 50, 0.9], [0, 10, 30, 46, 0.8], [-9, 0, -1, 5, 0.8], [50, 60, 99, 99, 0.5], [0, 0, 9, 9, 0.1]]
    )
    found, scores = decode_cells(rows.astype(np.float32), (64, 80), 0.25)
    np.testing.assert_allclose(found, [[0, 10, 30, 40], [50, 60, 14, 20]])
    np.testing.assert_allclose(scores, [0.9, 0.5], rtol=1e-6)


@pytest.mark.parametrize("name", ["d-fine", "rtmdet"])
def test_boxes_stand_in_the_full_sized_image_counted_from_pixel_centres(name: str, tmp_path: Path) -> None:
    # The whole picture of the left eye: 128 x 96 px fit into 64 x 64 as 64 x 48, from row 8 to 56.
    file = tmp_path / f"{name}.onnx"
    detector: DfineDetector | RtmdetDetector
    if name == "d-fine":
        logits, boxes = np.full((2, 3, 1), -9.0), np.full((2, 3, 4), 0.5)
        logits[0, 1], boxes[0, 1] = 2.0, [0.5, 0.5, 1.0, 0.75]
        detector = DfineDetector(write_queries_network(file, logits, boxes), 1)
    else:
        rows = np.zeros((2, 3, 5))
        rows[0, 1] = [0, 8, 64, 56, 0.9]
        detector = RtmdetDetector(write_rows_network(file, rows), 1)
    found = detector.candidates(images(np.full((96, 128, 3), 90, np.uint8)), 0.25)
    assert found["right"] == () and len(found["left"]) == 1 and detector.input_size_px == (64, 64)
    np.testing.assert_allclose(found["left"][0].box_xywh_px, [-0.5, -0.5, 128, 96], atol=1e-4)


def test_the_input_of_rtmdet_is_blue_green_red_with_mean_and_spread_of_its_training(tmp_path: Path) -> None:
    detector = RtmdetDetector(write_rows_network(tmp_path / "rows.onnx", np.zeros((2, 1, 5))), 1)
    red_green_blue = np.broadcast_to(np.array([10, 20, 30], np.uint8), (64, 64, 3))
    seen = detector._batch([np.ascontiguousarray(red_green_blue)] * 2)
    want = [(30 - 103.53) / 57.375, (20 - 116.28) / 57.12, (10 - 123.675) / 58.395]
    assert seen.shape == (2, 3, 64, 64) and seen.dtype == np.float32 and seen.flags.c_contiguous
    # Single precision of numbers around 1.
    np.testing.assert_allclose(seen[1, :, 5, 7], want, atol=1e-6)


def test_networks_with_other_outputs_are_refused(tmp_path: Path) -> None:
    rows = write_rows_network(tmp_path / "rows.onnx", np.zeros((2, 1, 5)))
    queries = write_queries_network(tmp_path / "queries.onnx", np.zeros((2, 1, 1)), np.zeros((2, 1, 4)))
    with pytest.raises(ValueError, match=r"rows\.onnx: must take two images and give rows of boxes"):
        DfineDetector(rows, 1)
    with pytest.raises(ValueError, match=r"queries\.onnx: must take two images and give rows of boxes"):
        RtmdetDetector(queries, 1)


def test_products_with_a_vector_are_counted(tmp_path: Path) -> None:
    # As D-FINE sums over the steps of its distributions.
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["images", "vector"], ["sums"])],
        "vector",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [2, 3, 32, 64])],
        [helper.make_tensor_value_info("sums", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.ones(64, np.float32), "vector")],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)]), str(tmp_path / "vector.onnx"))
    cost = network_cost(tmp_path / "vector.onnx", (64, 32))
    assert cost.parameters == 64
    assert cost.gflops_per_image == pytest.approx(2e-9 * 3 * 32 * 64, rel=1e-12)


def test_the_suppression_of_the_script_is_that_of_opencv() -> None:
    rng = np.random.default_rng(3)
    low, size, scores = rng.uniform(0, 40, (200, 2)), rng.uniform(5, 30, (200, 2)), rng.uniform(0, 1, 200)
    stay = non_maximum_suppression(torch.from_numpy(np.hstack((low, low + size))), torch.from_numpy(scores), 0.5)
    expected = cv2.dnn.NMSBoxes(np.hstack((low, size)).tolist(), scores.tolist(), 0.0, 0.5)
    np.testing.assert_array_equal(stay.numpy(), np.ravel(expected))
    assert 5 < len(stay) < 150
    assert non_maximum_suppression(torch.zeros(0, 4), torch.zeros(0), 0.5).shape == (0,)


def test_less_than_an_epoch_trains_on_the_first_images(tmp_path: Path) -> None:
    pictures = tmp_path / "pictures" / "images" / "train"
    pictures.mkdir(parents=True)
    (tmp_path / "network").mkdir()
    for name in "dbac":
        (pictures / f"{name}.png").write_bytes(b"")
    data = pictures.parents[1] / "data.yaml"
    assert training_data(data, tmp_path / "network", 1.0) == str(data)
    part = Path(training_data(data, tmp_path / "network", 0.5)).read_text()
    images_file = tmp_path / "network" / "train.txt"
    assert f'train: "{images_file}"' in part and f'path: "{data.parent}"' in part and part.endswith("0: drogue\n")
    assert images_file.read_text().split() == [str(pictures / "a.png"), str(pictures / "b.png")]


# Runs in the peers' environment: the boxes of libreyolo's own `predict` for a picture of the network's input.
PREDICT = """
import json, sys
sys.path.insert(0, sys.argv[1])
import libreyolo_script as script
script.replace_torchvision_operators()
network = script._NETWORKS[sys.argv[2]]
model = script.open_model(network, sys.argv[3], "cpu")
size = json.loads(sys.argv[5])
found = model.predict(sys.argv[4], conf=float(sys.argv[6]), iou=0.65, imgsz=size)
found = found[0] if isinstance(found, list) else found
print(json.dumps([found.boxes.xyxy.tolist(), found.boxes.conf.tolist()]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["d-fine-n", "rtmdet-tiny"])
def test_exported_networks_find_the_boxes_of_their_own_project(name: str, tmp_path: Path) -> None:
    """A training of four steps, whose network is run by libreyolo and by us."""
    if variable_of("libreyolo") not in os.environ:
        pytest.skip(f"{variable_of('libreyolo')} names no Python that has libreyolo")
    python, peer = Path(os.environ[variable_of("libreyolo")]), PEERS[name]
    size_px = peer.input_size_px((256, 192))
    data, picture = squares(tmp_path / "pictures", size_px)
    common = {"config": peer.config, "size_px": size_px}
    training: Mapping[str, Any] = common | {
        "do": "train",
        "data": str(data),
        "folder": str(tmp_path),
        "epochs": 2,
        "fraction": 1.0,
        "batch": 4,
        "threads": 1,
        "device": "cpu",
        "seed": 0,
    }
    variables = script_variables(tmp_path / "ultralytics", 1)
    run_script(python, peer.script, training, tmp_path / "train.log", variables)
    weights, file = tmp_path / "train" / "weights" / "best.pt", tmp_path / f"{name}.onnx"
    export = common | {"do": "export", "weights": str(weights), "file": str(file)}
    run_script(python, peer.script, export, tmp_path / "export.log", variables)
    detector = peer.open_detector(file, 1)
    assert detector.input_size_px == size_px
    found = detector.candidates(images(cv2.imread(str(picture))[..., ::-1]), 0.001)["right"]
    size = size_px[0] if peer.is_square else list(size_px[::-1])
    words = (peer.script.parent, peer.config, weights, picture, json.dumps(size), 0.001)
    corners, scores = read_by("libreyolo", PREDICT, *words, folder=tmp_path)
    assert len(found) > 10
    # Boxes count from pixel centres for us. Of nearly equal scores single precision may take another, so the best few.
    ours = np.array([each.box_xywh_px for each in found])
    ours[:, 2:] += ours[:, :2]
    ours += 0.5
    for corner, score in zip(corners[:5], scores[:5], strict=True):
        nearest = int(np.abs(ours - corner).max(axis=1).argmin())
        np.testing.assert_allclose(ours[nearest], corner, atol=0.05)
        assert found[nearest].score == pytest.approx(score, abs=1e-4)


def squares(folder: Path, size_px: tuple[int, int]) -> tuple[Path, Path]:
    """Eight pictures with a red square each to train on and to validate with, and one of them."""
    rng = np.random.default_rng(0)
    width, height = size_px
    for split in ("train", "val"):
        for kind in ("images", "labels"):
            (folder / kind / split).mkdir(parents=True)
        for index in range(8):
            picture = rng.integers(0, 60, (height, width, 3), np.uint8)
            x, y = rng.integers(0, width - 24), rng.integers(0, height - 24)
            picture[y : y + 24, x : x + 24] = (0, 0, 220)
            cv2.imwrite(str(folder / "images" / split / f"{index}.png"), picture)
            row = f"0 {(x + 12) / width} {(y + 12) / height} {24 / width} {24 / height}\n"
            (folder / "labels" / split / f"{index}.txt").write_text(row)
    data = folder / "data.yaml"
    data.write_text('path: ""\ntrain: images/train\nval: images/val\nnames:\n  0: drogue\n')
    return data, folder / "images" / "val" / "0.png"
