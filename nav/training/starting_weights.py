"""Weights of another training, from which a training starts instead of from random ones."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from drogue_models.untrusted_files import read_regular
from nav.detector.detector_registry import network_file
from nav.detector.network.network import DetectorNetwork, NetworkConfig
from nav.training.onnx_conversion import import_onnx
from nav.training.training_settings import TrainingSettings
from nav.training.training_state import load_checkpoint, new_network

_ADVICE = "give mobile-s, mobile-l, or detector.onnx or best.pt from a training's folder"


@dataclass(frozen=True, eq=False)
class StartingWeights:
    """The weights that a training starts from.

    Attributes:
        path: the file.
        sha256: of its bytes.
        values: every parameter and running mean by its name.
        network: configuration of the network; None where the file does not state it.
    """

    path: Path
    sha256: str
    values: dict[str, torch.Tensor]
    network: NetworkConfig | None = None

    @property
    def need_batch_statistics(self) -> bool:
        """Whether they are from an exported file; `recalibrate_batch_norm` must then follow before training."""
        return self.network is not None

    def load_into(self, network: nn.Module) -> None:
        """Replace all weights of a network.

        Raises:
            ValueError: they are of another network; the message names the file.
        """
        try:
            network.load_state_dict(self.values)
        except RuntimeError as error:
            own = "" if self.network is None else f", {', '.join(self.network.to_dict().values())}"
            raise ValueError(
                f"{self.path}: holds weights of another network{own}; "
                "give variant, attention and fusion as in its training"
            ) from error


def read_starting_weights(name_or_file: str) -> StartingWeights:
    """Read the weights of a shipped network, an exported `*.onnx`, or a training's `best.pt` or `checkpoint.pt`.

    Of a `checkpoint.pt` the averaged weights are taken.

    Raises:
        ValueError: the file is missing, truncated, or holds something else; the message names it.
    """
    path = network_file(name_or_file)
    return _from_checkpoint(Path(name_or_file)) if path is None else _from_onnx(path)


def _from_onnx(path: Path) -> StartingWeights:
    try:
        content = read_regular(path)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: is missing; {_ADVICE}") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        network = import_onnx(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; {_ADVICE}") from error
    return StartingWeights(path, hashlib.sha256(content).hexdigest(), network.state_dict(), network.config)


def _from_checkpoint(path: Path) -> StartingWeights:
    content: dict[str, Any] | None = load_checkpoint(path, _ADVICE)
    if content is None:
        raise ValueError(f"{path}: is missing; {_ADVICE}")
    values = content.get("average", content.get("network"))
    if not isinstance(values, dict) or not all(isinstance(value, torch.Tensor) for value in values.values()):
        raise ValueError(f"{path}: holds no weights; {_ADVICE}")
    return StartingWeights(path, hashlib.sha256(path.read_bytes()).hexdigest(), values)


def starting_network(settings: TrainingSettings, start: StartingWeights | None) -> DetectorNetwork:
    """The network that a training begins with: its weights are random, or those of another training.

    Raises:
        ValueError: the weights do not fit the network.
    """
    network = new_network(settings)
    if start is not None:
        start.load_into(network)
    return network


def settings_from_start(settings: TrainingSettings, start: StartingWeights | None) -> TrainingSettings:
    """The settings, with the hash of the weights that the training starts from.

    Raises:
        ValueError: the settings have the hash of other weights.
    """
    given = "" if start is None else start.sha256
    if settings.start_sha256 not in ("", given):
        raise ValueError(
            f"start_sha256: {settings.start_sha256} is not that of the weights given, {given or 'none'}; "
            "give the file that it names"
        )
    return settings.model_copy(update={"start_sha256": given})
