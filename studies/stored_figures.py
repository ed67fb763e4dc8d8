"""Figures that a study keeps on disk, so that a stopped run goes on: only for the same code and machine."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from datasets_manifest.atomic import write_text_atomic
from datasets_manifest.storage.manifest import cpu_features, software_versions
from droguekit.batch.progress import ProgressReport
from render.version import RENDER_VERSION

_MADE_BY = "made_by"
_MAKE_RESULTS = {".py", ".onnx"}
_RENDER = ("geometry", "drogue_models", "datasets_manifest", "scenes", "render")

RENDER_COMMAND = ("labelgen", "droguekit")
"""Packages beyond those that render whose code takes time in `droguekit render`."""


def code_fingerprint(rooms: Sequence[str]) -> str:
    """Hash of the sources and networks of packages."""
    digest = hashlib.sha256()
    for room in rooms:
        folder = Path(str(files(room)))
        for path in sorted(path for path in folder.rglob("*") if path.suffix in _MAKE_RESULTS):
            digest.update(f"{room}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def rendering_build(further_rooms: Sequence[str] = ()) -> dict[str, Any]:
    """What a cost of rendering depends on besides its options: render version, sources, packages and processor.

    Args:
        further_rooms: packages beyond those that render.
    """
    return {
        "render_version": RENDER_VERSION,
        "code": code_fingerprint((*_RENDER, *further_rooms)),
        "software": software_versions(),
        "processor": cpu_features(),
    }


def write_results(file: Path, results: Mapping[str, Mapping[str, Any]], made_by: Mapping[str, Any]) -> None:
    """Store results by their names, each with what made it; the file is written completely or not at all.

    Raises:
        OSError: it cannot be written.
    """
    table = {name: {**result, _MADE_BY: made_by} for name, result in results.items()}
    write_text_atomic(file, json.dumps(table, indent=1) + "\n")


def read_results(file: Path, made_by: Mapping[str, Any], report: ProgressReport) -> dict[str, dict[str, Any]]:
    """The results in a file that the same options, code and machine made, by their names; none without a file.

    Raises:
        ValueError: the file is damaged; names it.
        OSError: it cannot be read.
    """
    if not file.exists():
        return {}
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: is damaged, remove it to measure again: {error}") from error
    if not isinstance(stored, dict) or not all(isinstance(result, dict) for result in stored.values()):
        raise ValueError(f"{file}: holds no results, remove it or name another folder")
    known = {name: result for name, result in stored.items() if result.pop(_MADE_BY, None) == made_by}
    if len(known) < len(stored):
        others = f"{len(stored) - len(known)} of {len(stored)} results"
        report.say(f"{file}: {others} are of other options, code or machine, and are replaced")
    return known
