"""The state of a training on disk, from which it goes on as if it had never stopped."""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import torch

from datasets_manifest.atomic import PART_SUFFIX, open_bytes_atomic

CHECKPOINT_FILE, BEST_FILE = "checkpoint.pt", "best.pt"


def save(path: Path, state: dict[str, Any]) -> None:
    """Write or replace a file of tensors and plain values by one rename.

    Raises:
        OSError: it cannot be written; what was there before stays.
    """
    # torch's own writer reports a full disk as an internal error.
    stream = io.BytesIO()
    torch.save(state, stream)
    with open_bytes_atomic(path) as file:
        file.write(stream.getbuffer())


def load(path: Path, advice: str = "delete it, or train into another folder") -> dict[str, Any] | None:
    """What `save` wrote; None where there is no such file.

    Args:
        path: of the file.
        advice: what to do about a file that is damaged.

    Raises:
        ValueError: truncated, or another kind of file; names it.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        # Nothing but tensors and plain values is accepted: a file runs no code.
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, OSError, ValueError, KeyError, AttributeError) as error:
        raise ValueError(f"{path}: is truncated or no checkpoint; {advice}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path}: is no checkpoint; {advice}")
    return state


def remove_leftovers(folder: Path) -> None:
    """Delete what a killed training left half-written."""
    for leftover in folder.glob(f".*{PART_SUFFIX}"):
        if leftover.is_file():
            leftover.unlink()
