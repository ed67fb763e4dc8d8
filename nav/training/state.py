"""Everything that changes while a training runs, and its way to disk and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nav.detector.network.network import DetectorNetwork, NetworkConfig
from nav.training.checkpoint import CHECKPOINT_FILE, load, save
from nav.training.corpus import DatasetStamp
from nav.training.moving_average import MovingAverage
from nav.training.precision import Computing
from nav.training.training_progress import EpochRow
from nav.training.training_settings import TrainingSettings, differing_settings

_VERSION = 1  # grows with every change of what stands in a checkpoint


@dataclass(eq=False)
class TrainingState:
    """A training between two steps; draws need no state, for they are keyed by the number of the sample.

    Attributes:
        network, average, optimizer: what learns.
        step: steps done.
        losses: total loss of every step.
        parts: (score, box) losses of the steps since the last row.
        rows: of the epochs done.
        row_seconds: time that the steps since the last row took. [s]
        best: (stage, average precision) of the best weights so far; a stage is an input size.
    """

    network: DetectorNetwork
    average: MovingAverage
    optimizer: torch.optim.Optimizer
    step: int = 0
    losses: list[float] = field(default_factory=list)
    parts: list[tuple[float, float]] = field(default_factory=list)
    rows: list[EpochRow] = field(default_factory=list)
    row_seconds: float = 0.0
    best: tuple[int, float] = (-1, -math.inf)


def new_network(settings: TrainingSettings) -> DetectorNetwork:
    """A network whose random weights follow from the seed."""
    config = NetworkConfig(settings.variant, settings.attention, settings.fusion)
    # torch initialises layers from its own generator, which is put back afterwards.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return DetectorNetwork(config)


def new_state(network: DetectorNetwork, settings: TrainingSettings, computing: Computing) -> TrainingState:
    """The state of a network before the first step."""
    network.to(computing.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    return TrainingState(network, MovingAverage(network, settings.ema_decay), _new_optimizer(network, settings))


def _new_optimizer(network: nn.Module, settings: TrainingSettings) -> torch.optim.Optimizer:
    """Weight decay pulls filters only: offsets and scales of normalization have one value a channel to learn."""
    filters = [weights for weights in network.parameters() if weights.ndim > 1]
    others = [weights for weights in network.parameters() if weights.ndim <= 1]
    groups = [{"params": filters, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
    if settings.optimizer == "sgd":
        return torch.optim.SGD(groups, lr=settings.learning_rate, momentum=0.9, nesterov=True)
    return torch.optim.AdamW(groups, lr=settings.learning_rate)


def save_state(out: Path, state: TrainingState, settings: TrainingSettings, datasets: Sequence[DatasetStamp]) -> None:
    """Write `checkpoint.pt`, whole or not at all.

    Raises:
        OSError: it cannot be written; the one before stays.
    """
    content: dict[str, Any] = {
        "version": _VERSION,
        "settings": settings.model_dump(mode="json"),
        "datasets": [asdict(stamp) for stamp in datasets],
        "network": state.network.state_dict(),
        "average": state.average.network.state_dict(),
        "optimizer": state.optimizer.state_dict(),
        "step": state.step,
        "losses": state.losses,
        "parts": state.parts,
        "rows": [asdict(row) for row in state.rows],
        "row_seconds": state.row_seconds,
        "best": state.best,
    }
    save(out / CHECKPOINT_FILE, content)


def check_settings(out: Path, settings: TrainingSettings) -> None:
    """Whether a folder can be trained in with these settings.

    Raises:
        ValueError: as `restore_state`, but for the datasets.
    """
    content = load(out / CHECKPOINT_FILE)
    if content is not None:
        _check_same(out / CHECKPOINT_FILE, content, settings, None)


def _check_same(
    path: Path, content: dict[str, Any], settings: TrainingSettings, datasets: Sequence[DatasetStamp] | None
) -> None:
    if content.get("version") != _VERSION:
        raise ValueError(f"{path}: is of another version of droguekit; train into another folder")
    differing = differing_settings(content.get("settings", {}), settings.model_dump(mode="json"))
    if datasets is not None and content.get("datasets") != [asdict(stamp) for stamp in datasets]:
        differing.append("datasets")
    if differing:
        raise ValueError(
            f"{path}: belongs to a training that differs in {', '.join(differing)}; give the same, or another folder"
        )


def restore_state(
    out: Path, state: TrainingState, settings: TrainingSettings, datasets: Sequence[DatasetStamp]
) -> bool:
    """Put the state that `save_state` wrote into a new one; whether there was any.

    Raises:
        ValueError: a file that is truncated or of another version, or of other settings or datasets; names it and the
            keys.
    """
    path = out / CHECKPOINT_FILE
    content = load(path)
    if content is None:
        return False
    _check_same(path, content, settings, datasets)
    try:
        state.network.load_state_dict(content["network"])
        state.average.network.load_state_dict(content["average"])
        state.optimizer.load_state_dict(content["optimizer"])
        state.step, state.losses, state.row_seconds = content["step"], content["losses"], content["row_seconds"]
        state.parts, state.rows = content["parts"], [EpochRow(**row) for row in content["rows"]]
        state.best = content["best"]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: does not fit this network; delete it, or train into another folder") from error
    return True
