"""Whether results on disk were made by this code, so that a stopped run can continue."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from datasets_manifest.atomic import write_text_atomic
from studies.stored_figures import code_fingerprint

_ROOMS = ("geometry", "drogue_models", "nav", "studies.acceptance", "droguekit.scoring")


def results_fingerprint() -> str:
    """Hash of the sources and networks that determine results of drawn centroids."""
    return code_fingerprint(_ROOMS)


# Packages between the pixels and the estimates, readers and file formats included.
_ROOMS_OF_ESTIMATES = ("geometry", "drogue_models", "datasets_manifest", "nav")


def is_navigated(estimates: Path, dataset_sha256: str, methods: Sequence[str]) -> bool:
    """Whether the file exists unchanged and was made by this code, with these methods, from this dataset."""
    stamp = _stamp_path(estimates)
    if not (estimates.exists() and stamp.exists()):
        return False
    return stamp.read_text(encoding="utf-8") == _stamp(estimates, dataset_sha256, methods)


def mark_navigated(estimates: Path, dataset_sha256: str, methods: Sequence[str]) -> None:
    """Record beside the file what it was made from.

    Raises:
        OSError: it cannot be written.
    """
    write_text_atomic(_stamp_path(estimates), _stamp(estimates, dataset_sha256, methods))


def _stamp_path(estimates: Path) -> Path:
    return estimates.with_suffix(".made-from.json")


def _stamp(estimates: Path, dataset_sha256: str, methods: Sequence[str]) -> str:
    made_from = {
        "dataset_sha256": dataset_sha256,
        "methods": list(methods),
        "code": code_fingerprint(_ROOMS_OF_ESTIMATES),
        "estimates_sha256": hashlib.sha256(estimates.read_bytes()).hexdigest(),
    }
    return json.dumps(made_from, indent=1) + "\n"
