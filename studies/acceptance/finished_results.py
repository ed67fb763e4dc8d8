"""Whether results on disk were made by this code, so that a stopped run can continue."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from datasets_manifest.atomic import write_text_atomic

_MAKE_RESULTS = {".py", ".onnx"}
_ROOMS = ("geometry", "drogue_models", "nav", "studies.acceptance", "droguekit.scoring")


def code_fingerprint(rooms: Sequence[str] = _ROOMS) -> str:
    """Hash of the sources and networks that determine results."""
    digest = hashlib.sha256()
    for room in rooms:
        folder = Path(str(files(room)))
        for path in sorted(path for path in folder.rglob("*") if path.suffix in _MAKE_RESULTS):
            digest.update(f"{room}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


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
