"""Weights that another training found, for one to start from instead of random ones."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from nav.training.checkpoint import load
from nav.training.settings import TrainingSettings


@dataclass(frozen=True, eq=False)
class StartingWeights:
    """What a training starts from.

    Attributes:
        path: the file.
        sha256: of its bytes.
        values: name and value of every parameter and running mean.
    """

    path: Path
    sha256: str
    values: dict[str, torch.Tensor]

    def put_into(self, network: nn.Module) -> None:
        """Replace all weights of a network.

        Raises:
            ValueError: they are another network's; names the file.
        """
        try:
            network.load_state_dict(self.values)
        except RuntimeError as error:
            raise ValueError(
                f"{self.path}: holds weights of another network; give variant, attention and fusion as in its training"
            ) from error


def read_starting_weights(path: Path) -> StartingWeights:
    """The weights in `best.pt` of a training's folder, or the averaged ones in its `checkpoint.pt`.

    Raises:
        ValueError: missing, truncated, or a file of something else; names it.
    """
    advice = "give best.pt from a training's folder"
    content: dict[str, Any] | None = load(path, advice)
    if content is None:
        raise ValueError(f"{path}: is missing; {advice}")
    values = content.get("average", content.get("network"))
    if not isinstance(values, dict) or not all(isinstance(value, torch.Tensor) for value in values.values()):
        raise ValueError(f"{path}: holds no weights; {advice}")
    return StartingWeights(path, hashlib.sha256(path.read_bytes()).hexdigest(), values)


def settings_from_start(settings: TrainingSettings, start: StartingWeights | None) -> TrainingSettings:
    """Settings that say which weights the training starts from.

    Raises:
        ValueError: they name others already.
    """
    given = "" if start is None else start.sha256
    if settings.start_sha256 not in ("", given):
        raise ValueError(
            f"start_sha256: {settings.start_sha256} is not that of the weights given, {given or 'none'}; "
            "give the file that it names"
        )
    return settings.model_copy(update={"start_sha256": given})
