from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper
from torch import nn

from droguekit.batch.progress import PlainProgress
from nav.detector.detector_registry import network_file
from nav.detector.input_image import network_input
from nav.detector.model_metadata import METADATA_KEY, ModelMetadata
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from nav.training.onnx_conversion import import_onnx, recalibrate_batch_norm, trace_onnx, write_onnx
from nav.training.training_run import check_training, train
from nav.training.training_settings import build_settings
from nav.training.training_state import read_starting_weights, save_checkpoint

NETWORKS = [NetworkConfig("l", "eca", "asff"), NetworkConfig("s", "se", "concat")]


def some_images(seed: int, count: int = 4) -> torch.Tensor:
    return torch.rand(count, 3, 96, 128, generator=torch.Generator().manual_seed(seed))


def worn_network(config: NetworkConfig) -> DetectorNetwork:
    """A network whose normalisation and last layers are as different between channels as after a training."""
    torch.manual_seed(2)
    network = DetectorNetwork(config)
    # A channel whose output is zero must not lead to a division by zero.
    dead = next(module for module in network.modules() if isinstance(module, nn.Conv2d))
    with torch.no_grad():
        dead.weight[3] = 0
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.weight.uniform_(0.3, 2.0)
                module.bias.normal_(0, 0.3)
        network.train()
        for seed in range(8):
            network(some_images(seed))
    return network.eval()


def maps_of(network: DetectorNetwork, images: torch.Tensor) -> list[torch.Tensor]:
    with torch.inference_mode():
        return [each.clone() for each in network(images)]


def exported(network: DetectorNetwork, path: Path) -> bytes:
    write_onnx(trace_onnx(network), path, ModelMetadata(network=network.config.to_dict()))
    return path.read_bytes()


@pytest.mark.parametrize("config", NETWORKS, ids=str)
def test_an_imported_network_keeps_its_outputs_when_batch_norm_is_recalibrated(
    config: NetworkConfig, tmp_path: Path
) -> None:
    network, images = worn_network(config), some_images(9)
    back = import_onnx(exported(network, tmp_path / "detector.onnx"))
    assert back.config == config
    # Sums over up to 960 channels in another order, a hundred layers deep, in float32.
    close = {"rtol": 1e-3, "atol": 1e-3}
    wanted = maps_of(network, images)
    for mine, theirs in zip(maps_of(back, images), wanted, strict=True):
        torch.testing.assert_close(mine, theirs, **close)
    measured = [some_images(seed) for seed in range(20, 26)]
    recalibrate_batch_norm(back, measured)
    assert not back.training
    for mine, theirs in zip(maps_of(back, images), wanted, strict=True):
        torch.testing.assert_close(mine, theirs, **close)
    # In training each layer normalises by its own batch: over all images that were measured that is the same, but for
    # variances as differences of squares, whose rounding grows with the depth.
    every = torch.cat(measured)
    alone = maps_of(back, every)
    for mine, theirs in zip(maps_of(back.train(), every), alone, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-2, atol=1e-2)
    lengths = back.backbone.stem_weights.flatten(1).norm(dim=1).tolist()
    np.testing.assert_allclose(lengths, [0 if channel == 3 else 2**0.5 for channel in range(16)], rtol=1e-5)


def test_shipped_weights_are_what_onnxruntime_runs() -> None:
    start = read_starting_weights("mobile-s")
    assert start.path == network_file("mobile-s") and start.network == NetworkConfig("s", "eca", "asff")
    network = DetectorNetwork(start.network)
    start.load_into(network)
    images = np.random.default_rng(0).integers(0, 256, (2, 96, 128, 3), np.uint8)
    batch = network_input(list(images))
    session = onnxruntime.InferenceSession(str(start.path), providers=["CPUExecutionProvider"])
    for mine, theirs in zip(
        maps_of(network.eval(), torch.from_numpy(batch)), session.run(None, {"images": batch}), strict=True
    ):
        np.testing.assert_allclose(mine.numpy(), theirs, rtol=1e-3, atol=1e-3)


SMALL = {
    "variant": "s",
    "size_px": (96, 128),
    "batch_images": 4,
    "image_passes": 4,
    "warmup_fraction": 0.1,
    "precision": "float32",
    "threads": 1,
}


def test_a_training_starts_from_a_shipped_network(split_dataset: Path, tmp_path: Path) -> None:
    start, told = read_starting_weights("mobile-s"), io.StringIO()
    # At a negligible learning rate the outputs are those of the shipped network, but for the statistics of this corpus.
    settings = build_settings(None, {**SMALL, "learning_rate": 1e-12})
    result = train([split_dataset], tmp_path / "out", settings, PlainProgress(told), start=start)
    learned = import_onnx(result.file.read_bytes())
    images = some_images(1)
    shipped = DetectorNetwork(NetworkConfig("s"))
    start.load_into(shipped)
    random = maps_of(DetectorNetwork(NetworkConfig("s")).eval(), images)
    for mine, theirs, other in zip(maps_of(learned, images), maps_of(shipped.eval(), images), random, strict=True):
        # Means and variances come from so few images here that they differ between the two sizes of the batches.
        assert (mine - theirs).abs().mean() < 0.2 * (other - theirs).abs().mean()
    metadata = {entry.key: entry.value for entry in onnx.load(result.file).metadata_props}
    file = network_file("mobile-s")
    assert file is not None
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    assert ModelMetadata.from_json(metadata[METADATA_KEY]).training["settings"]["start_sha256"] == digest
    with pytest.raises(
        ValueError, match=r"mobile-s\.onnx: holds weights of another network, s, eca, asff; give variant"
    ):
        check_training(tmp_path / "third", settings.model_copy(update={"variant": "l"}), start)


def test_settings_precede_the_network_of_the_weights(tmp_path: Path) -> None:
    file, shipped = tmp_path / "mine.toml", {"variant": "s", "attention": "se", "fusion": "concat"}
    file.write_text('attention = "eca"\n')
    settings = build_settings(file, {"fusion": "asff"}, shipped)
    assert (settings.variant, settings.attention, settings.fusion) == ("s", "eca", "asff")


@pytest.mark.slow
def test_a_resumed_training_keeps_what_it_learned_and_not_its_start(split_dataset: Path, tmp_path: Path) -> None:
    start, settings = read_starting_weights("mobile-s"), build_settings(None, {**SMALL, "image_passes": 16})
    whole = train([split_dataset], tmp_path / "whole", settings, PlainProgress(io.StringIO()), start=start)
    steps = iter(range(10))
    with pytest.raises(KeyboardInterrupt):
        train(
            [split_dataset], tmp_path / "parts", settings, PlainProgress(io.StringIO()),
            should_stop=lambda: next(steps) == 1, start=start,
        )  # fmt: skip
    parts = train([split_dataset], tmp_path / "parts", settings, PlainProgress(io.StringIO()), start=start)
    assert (tmp_path / "parts" / "losses.csv").read_text() == (tmp_path / "whole" / "losses.csv").read_text()
    images = some_images(4)
    first, second = (import_onnx(result.file.read_bytes()) for result in (whole, parts))
    for mine, theirs in zip(maps_of(first, images), maps_of(second, images), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4)


def model_with(change: str) -> bytes:
    """The shipped small network with something wrong."""
    file = network_file("mobile-s")
    assert file is not None
    model = onnx.load_from_string(file.read_bytes())
    if change == "unnamed":
        onnx.helper.set_model_props(model, {})
    elif change == "named l":
        stated = ModelMetadata(network=NetworkConfig("l").to_dict())
        onnx.helper.set_model_props(model, {METADATA_KEY: stated.to_json()})
    elif change == "unknown":
        stated = ModelMetadata(network={"variant": "xl"})
        onnx.helper.set_model_props(model, {METADATA_KEY: stated.to_json()})
    elif change == "outside":
        onnx.external_data_helper.set_external_data(model.graph.initializer[0], "/etc/hostname")
    elif change == "reshaped":
        first = next(node for node in model.graph.node if node.op_type == "Conv")
        weight = next(each for each in model.graph.initializer if each.name == first.input[1])
        weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight)[:-1], weight.name))
    return bytes(model.SerializeToString())


_ADVICE = "give mobile-s, mobile-l, or detector.onnx or best.pt from a training's folder"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("best.pt", None, "is missing"),
        ("best.pt", b"PK truncated", "is truncated or not a checkpoint"),
        ("best.pt", {"step": 3}, "holds no weights"),
        ("mine.onnx", None, "is missing"),
        ("mine.onnx", b"\x08PK truncated", "is truncated or not an ONNX file"),
        ("mine.onnx", b"", "does not say which of droguekit's networks it is"),
        ("mine.onnx", "unnamed", "does not say which of droguekit's networks it is"),
        ("mine.onnx", "unknown", "variant: must be one of l, s, got 'xl'"),
        ("mine.onnx", "named l", "does not have the layers of the network that its metadata states"),
        ("mine.onnx", "outside", "keeps its weights in other files"),
        ("mine.onnx", "reshaped", "does not have the layers of the network that its metadata states"),
    ],
)
def test_weights_to_start_from_that_cannot_be_used(name: str, content: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if isinstance(content, dict):
        save_checkpoint(path, content)
    elif content is not None:
        path.write_bytes(model_with(content) if isinstance(content, str) else content)
    with pytest.raises(ValueError) as caught:
        read_starting_weights(str(path))
    assert str(caught.value) == f"{path}: {message}; {_ADVICE}"


def test_a_folder_is_not_a_file_of_weights(tmp_path: Path) -> None:
    (tmp_path / "mine.onnx").mkdir()
    with pytest.raises(ValueError, match=r"mine\.onnx: cannot be read: Is a directory"):
        read_starting_weights(str(tmp_path / "mine.onnx"))


def test_checkpoints_need_no_statistics(tmp_path: Path) -> None:
    network = worn_network(NetworkConfig("s"))
    save_checkpoint(tmp_path / "best.pt", {"network": network.state_dict(), "step": 1})
    start = read_starting_weights(str(tmp_path / "best.pt"))
    assert not start.need_batch_statistics
