from __future__ import annotations

import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper

from datasets_manifest.types.images import StereoImages
from geometry.stereo import EYES
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.network.network import NetworkConfig
from nav.detector.onnx_detector import OnnxDetector
from nav.training.onnx_conversion import INPUT_NAME, OUTPUT_NAMES, trace_onnx, write_onnx
from tests.support.detector_networks import make_network, write_red_squares

METADATA = ModelMetadata(input_size_px=(320, 256), score_threshold=0.6, licence="Apache-2.0")
# In cells of 8 px of the 320x256 input: column and row of a red square of one cell.
PLACES = {"left": (7, 5), "right": (3, 20)}
IMAGE_PX = (640, 512)


def red_squares_pair(times: int = 1) -> StereoImages:
    """Grey images with a red square of 16 `times` px each, that fills cells of 8 px after halving."""
    images = []
    for eye in EYES:
        column, row = PLACES[eye]
        image = np.full((IMAGE_PX[1], IMAGE_PX[0], 3), 120, np.uint8)
        image[16 * row : 16 * (row + times), 16 * column : 16 * (column + times)] = (255, 0, 0)
        images.append(image)
    return StereoImages(images[0], images[1], 0.0, 0.0, encoding="gamma")


def one_line(error: pytest.ExceptionInfo[ValueError], file: Path) -> None:
    assert str(error.value).startswith(f"{file}: ")
    assert "\n" not in str(error.value)


def test_finds_the_boxes_of_a_hand_made_network(tmp_path: Path) -> None:
    detector = OnnxDetector(write_red_squares(tmp_path, metadata=METADATA))
    found = detector.detect(red_squares_pair())
    for eye in EYES:
        detection = found.of(eye)
        assert detection is not None
        column, row = PLACES[eye]
        # One stride from the cell's centre on each side is two cells of 16 px of the image; pixel centres are at 0.5.
        expected = (16 * column - 8 - 0.5, 16 * row - 8 - 0.5, 32, 32)
        # float32 of numbers of some hundreds.
        np.testing.assert_allclose(detection.box_xywh_px, expected, atol=1e-3)
        assert detection.score == pytest.approx(1 / (1 + np.exp(-10)), abs=1e-5)


def test_candidates_are_sorted_and_above_the_least_score(tmp_path: Path) -> None:
    detector = OnnxDetector(write_red_squares(tmp_path, metadata=METADATA))
    found = detector.candidates(red_squares_pair(times=3), least_score=0.2)
    for eye in EYES:
        scores = [each.score for each in found[eye]]
        assert len(scores) >= 2
        assert scores == sorted(scores, reverse=True) and min(scores) >= 0.2


def test_no_drogue_is_none_and_not_an_error(tmp_path: Path) -> None:
    grey = np.full((IMAGE_PX[1], IMAGE_PX[0], 3), 120, np.uint8)
    detector = OnnxDetector(write_red_squares(tmp_path, metadata=METADATA))
    pair = StereoImages(grey, grey, 0.0, 0.0)
    found = detector.detect(pair)
    assert found.left is None and found.right is None
    assert detector.candidates(pair, 0.5) == {"left": (), "right": ()}


def test_one_eye_may_see_no_drogue(tmp_path: Path) -> None:
    pair = red_squares_pair()
    pair = replace(pair, right=np.full_like(pair.right, 120))
    found = OnnxDetector(write_red_squares(tmp_path, metadata=METADATA)).detect(pair)
    assert found.left is not None and found.right is None


def test_the_threshold_is_that_of_the_file(tmp_path: Path) -> None:
    for threshold, sees in ((0.99995, True), (0.99996, False)):
        # The square's score is 0.9999546.
        detector = OnnxDetector(write_red_squares(tmp_path, metadata=replace(METADATA, score_threshold=threshold)))
        assert (detector.detect(red_squares_pair()).left is not None) == sees


def test_input_size_is_that_of_the_file_or_the_given_one(tmp_path: Path) -> None:
    file = write_red_squares(tmp_path, metadata=METADATA)
    assert OnnxDetector(file).input_size_px == (320, 256)
    larger = OnnxDetector(file, input_size_px=(640, 512))
    assert larger.input_size_px == (640, 512)
    # Unreduced, the square is a whole cell of stride 16, and its box two of them.
    found = larger.detect(red_squares_pair()).left
    assert found is not None
    assert found.box_xywh_px[2] in (pytest.approx(16, abs=1e-3), pytest.approx(32, abs=1e-3))
    with pytest.raises(ValueError, match="input_size_px: must be multiples of 32, got 300x200"):
        OnnxDetector(file, input_size_px=(300, 200))


def test_a_network_of_fixed_size_needs_no_metadata(tmp_path: Path) -> None:
    file = write_red_squares(tmp_path, shape=("b", 3, 256, 320))
    assert OnnxDetector(file).detect(red_squares_pair()).left is not None
    with pytest.raises(ValueError, match="takes 320x256 px only") as error:
        OnnxDetector(file, input_size_px=(640, 480))
    one_line(error, file)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({}, "takes any size and has no metadata 'droguekit_detector'"),
        ({"metadata": METADATA, "channels": 6}, "outputs must be maps of numbers"),
        ({"metadata": METADATA, "strides": (8, 16)}, "outputs must be maps of numbers"),
        ({"metadata": METADATA, "strides": (8, 16, 16)}, "does not run|not an ONNX network"),
        ({"metadata": METADATA, "strides": (4, 8, 16)}, "outputs must be maps of numbers"),
        ({"metadata": METADATA, "shape": (1, 3, 256, 320)}, "takes one image a pass"),
        ({"metadata": METADATA, "shape": ("b", 3, 250, 320)}, "must be multiples of 32, got 320x250"),
        ({"metadata": METADATA, "shape": ("b", 3, 256, "w")}, "must both be fixed or both dynamic, got wx256"),
        ({"metadata": METADATA, "shape": ("b", 3, 32, 32_000)}, "must be at most 4096, got 32000x32"),
        (
            {"metadata": METADATA, "shape": ("b", 1, "h", "w")},
            r"one float32 input \(B, 3, H, W\)|not an ONNX network",
        ),
    ],
)
def test_networks_of_another_kind_are_refused(tmp_path: Path, kwargs: dict[str, Any], message: str) -> None:
    file = write_red_squares(tmp_path, **kwargs)
    with pytest.raises(ValueError, match=message) as error:
        OnnxDetector(file)
    one_line(error, file)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "metadata: is not JSON"),
        ("[1]", "metadata: must be an object, got list"),
        ('{"input_size_px": [320, 250]}', "input_size_px: must be two multiples of 32"),
        ('{"input_size_px": 320}', "input_size_px: must be a list"),
        ('{"input_size_px": [320, 32000]}', "input_size_px: must be at most 4096 a side"),
        ('{"score_threshold": "high"}', "score_threshold: must be 0 to 1"),
        ('{"score_threshold": true}', "score_threshold: must be 0 to 1, got True"),
        ('{"licence": 5}', "licence: must be a text, got 5"),
        ('{"training": []}', "training: must be an object"),
        ('{"colour": 1}', "metadata: has unknown keys colour"),
    ],
)
def test_metadata_that_makes_no_sense_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = write_red_squares(tmp_path)
    model = onnx.load(file)
    helper.set_model_props(model, {METADATA_KEY: text})
    onnx.save(model, file)
    with pytest.raises(ValueError, match=message) as error:
        OnnxDetector(file)
    one_line(error, file)


@pytest.mark.parametrize("content", [b"", b"not a network", b"\x89PNG\r\n\x1a\n" + bytes(100), bytes(1000)])
def test_files_that_are_no_networks_are_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "network.onnx"
    file.write_bytes(content)
    with pytest.raises(ValueError, match="is truncated or not an ONNX network") as error:
        OnnxDetector(file)
    one_line(error, file)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_refused(tmp_path: Path, share: float) -> None:
    file = write_red_squares(tmp_path, metadata=METADATA)
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError) as error:
        OnnxDetector(file)
    one_line(error, file)


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    for file in (tmp_path / "missing.onnx", tmp_path):
        with pytest.raises(ValueError, match="cannot be read") as error:
            OnnxDetector(file)
        one_line(error, file)


def test_a_file_cannot_name_other_files_to_be_read(tmp_path: Path) -> None:
    file = write_red_squares(tmp_path, metadata=METADATA)
    model = onnx.load(file)
    (tmp_path / "secret").write_bytes(bytes(60))
    (weights,) = (each for each in model.graph.initializer if each.name == "weights")
    weights.ClearField("raw_data")
    weights.data_location = TensorProto.EXTERNAL
    weights.external_data.add(key="location", value="secret")
    file.write_bytes(model.SerializeToString())
    with pytest.raises(ValueError) as error:
        OnnxDetector(file)
    one_line(error, file)


def test_threads_must_be_positive(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="threads: must be at least 1, got 0"):
        OnnxDetector(write_red_squares(tmp_path, metadata=METADATA), threads=0)


@pytest.mark.parametrize(
    "config",
    [NetworkConfig("l"), NetworkConfig("s", "se", "concat")],
    ids=lambda config: "-".join(config.to_dict().values()),
)
def test_exported_network_has_the_outputs_of_torch(tmp_path: Path, config: NetworkConfig) -> None:
    trained, file = make_network(config), tmp_path / "net" / "network.onnx"
    metadata = replace(METADATA, network=config.to_dict(), manifest_sha256="ab" * 32, training={"passes": 7})
    before = {name: value.clone() for name, value in trained.state_dict().items()}
    write_onnx(trace_onnx(trained.train()), file, metadata)
    assert trained.training
    assert all(torch.equal(value, before[name]) for name, value in trained.state_dict().items())
    trained.eval()
    assert [path.name for path in file.parent.iterdir()] == [file.name]
    detector = OnnxDetector(file)
    assert detector.metadata == metadata
    session = onnxruntime.InferenceSession(file.read_bytes(), providers=["CPUExecutionProvider"])
    for shape in ((1, 3, 64, 96), (3, 3, 128, 64)):
        images = np.random.default_rng(5).random(shape, dtype=np.float32)
        with torch.no_grad():
            expected = [each.numpy() for each in trained(torch.from_numpy(images))]
        for output, reference in zip(session.run(list(OUTPUT_NAMES), {INPUT_NAME: images}), expected, strict=True):
            # Some 60 float32 layers summed in another order, with normalisation folded into the weights.
            np.testing.assert_allclose(output, reference, atol=2e-4 * max(1.0, float(np.abs(reference).max())))


def test_an_export_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "network.onnx").mkdir()
    with pytest.raises(OSError, match=r"network\.onnx: cannot be written"):
        write_onnx(trace_onnx(make_network(NetworkConfig("s"))), tmp_path / "network.onnx", METADATA)
    assert [path.name for path in tmp_path.iterdir()] == ["network.onnx"]


def test_weights_in_another_file_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even below the working directory."""
    file = write_red_squares(tmp_path, metadata=METADATA)
    model = onnx.load(file)
    onnx.save(model, file, save_as_external_data=True, location="weights.bin", size_threshold=0)
    assert (tmp_path / "weights.bin").stat().st_size > 0
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="is truncated or not an ONNX network") as caught:
        OnnxDetector(file)
    one_line(caught, file)


def write_endless_network(path: Path) -> Path:
    """A network whose loop takes longer than anybody waits."""
    true = helper.make_tensor("go_on", TensorProto.BOOL, [], [True])
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["cond_in"], ["cond_out"]),
            helper.make_node("Identity", ["state"], ["state_out"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("count", TensorProto.INT64, []),
            helper.make_tensor_value_info("cond_in", TensorProto.BOOL, []),
            helper.make_tensor_value_info("state", TensorProto.FLOAT, [2, 3, 64, 64]),
        ],
        [
            helper.make_tensor_value_info("cond_out", TensorProto.BOOL, []),
            helper.make_tensor_value_info("state_out", TensorProto.FLOAT, [2, 3, 64, 64]),
        ],
    )
    graph = helper.make_graph(
        [helper.make_node("Loop", ["", "go_on", "images"], ["found"], body=body)],
        "endless",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [2, 3, 64, 64])],
        [helper.make_tensor_value_info("found", TensorProto.FLOAT, [2, 3, 64, 64])],
        [true],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    path.write_bytes(model.SerializeToString())
    return path


def test_an_endless_network_hears_of_an_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, threads = write_endless_network(tmp_path / "endless.onnx"), []
    begin = threading.Thread.start

    def start(thread: threading.Thread) -> None:
        threads.append(thread)
        begin(thread)
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    monkeypatch.setattr(threading.Thread, "start", start)
    try:
        with pytest.raises(KeyboardInterrupt):
            OnnxDetector(file)
    finally:
        signal.signal(signal.SIGINT, before)
    # The network itself ends too.
    threads[-1].join()


def test_a_network_that_grows_beyond_the_memory_is_refused(tmp_path: Path) -> None:
    """A few hundred bytes whose result, or a constant part, has 14 GB."""
    shape = helper.make_tensor("shape", TensorProto.INT64, [4], [1, 1, 60_000, 60_000])
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, ["batch", 3, 64, 96])
    result = helper.make_tensor_value_info("found", TensorProto.FLOAT, None)
    for first, second in (
        (helper.make_node("Expand", ["one", "shape"], ["found"]), helper.make_node("ReduceSum", ["images"], ["one"])),
        (
            helper.make_node("Add", ["images", "one"], ["found"]),
            helper.make_node("ConstantOfShape", ["shape"], ["one"]),
        ),
    ):
        graph = helper.make_graph([second, first], "grows", [images], [result], [shape])
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
        model.ir_version = 8
        file = tmp_path / "grows.onnx"
        file.write_bytes(model.SerializeToString())
        with pytest.raises(ValueError, match=r"grows\.onnx: (does not run|is truncated or not)") as caught:
            OnnxDetector(file)
        one_line(caught, file)
