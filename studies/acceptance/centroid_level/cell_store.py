"""Finished cells on disk, so that a stopped run goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from datasets_manifest.atomic import write_text_atomic
from droguekit.batch.progress import ProgressReport
from studies.acceptance.centroid_level.monte_carlo import Cell, CellResult, run_cell

CELLS_FILE = "cells.json"
_MAKE_RESULTS = {".py", ".onnx"}
_ROOMS = ("geometry", "drogue_models", "nav", "studies.acceptance", "droguekit.benchmark")


def code_fingerprint(rooms: Sequence[str] = _ROOMS) -> str:
    """Hash of the sources and networks on which results rest: others make other results."""
    digest = hashlib.sha256()
    for room in rooms:
        folder = Path(str(files(room)))
        for path in sorted(path for path in folder.rglob("*") if path.suffix in _MAKE_RESULTS):
            digest.update(f"{room}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def run_cells(cells: Sequence[Cell], out: Path, report: ProgressReport) -> dict[Cell, CellResult]:
    """Results of all cells; those that `out` holds already, made by the same code, are not made again.

    Raises:
        ValueError: a cell that cannot be run, or `cells.json` is not ours.
        OSError: the folder cannot be written.
    """
    path, code = out / CELLS_FILE, code_fingerprint()
    known = _read(path, code, report)
    wanted = list(dict.fromkeys(cells))
    todo = [cell for cell in wanted if repr(cell) not in known]
    if len(todo) < len(wanted):
        report.say(f"{len(wanted) - len(todo)} of {len(wanted)} cells are there already")
    report.begin("cells", len(todo))
    try:
        for cell in todo:
            known[repr(cell)] = run_cell(cell)
            table = {"code": code, "cells": {key: value.model_dump() for key, value in known.items()}}
            write_text_atomic(path, json.dumps(table, indent=1, allow_nan=False) + "\n")
            report.advance()
    finally:
        report.end()
    return {cell: known[repr(cell)] for cell in wanted}


def _read(path: Path, code: str, report: ProgressReport) -> dict[str, CellResult]:
    if not path.exists():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        made_by, cells = str(table["code"]), dict(table["cells"].items())
        if made_by == code:
            return {key: CellResult.model_validate(value) for key, value in cells.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: does not hold cells of this command; move it away or choose another --out"
        ) from error
    report.say(f"{path} was made by other code: its cells are made again")
    return {}
